"""Comparison of strategies: runs, measures of each run, and tables with one row per strategy."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from evercal.continual.benchmark.published import LOOSE, PublishedScene
from evercal.continual.benchmark.results import NETWORK, SceneResult
from evercal.continual.benchmark.statistics import (
    Interval,
    frame_pieces,
    mean_interval,
    seeds_interval,
)
from evercal.errors import InputError
from evercal.evaluation.metrics import (
    COARSE,
    FINE,
    MIDDLE,
    ContinualScores,
    continual_scores,
    recall_area,
    share_inside,
)
from evercal.evaluation.tables import Style, table

if TYPE_CHECKING:
    from pandas import DataFrame

TableRows = list[list[str]]
"""Cells of a table, header first."""
Measures = Mapping[str, Callable[["Run"], float]]
"""Numbers of a run, by the title of their column."""


@dataclass(frozen=True)
class Run:
    """A complete run: one strategy with one seed over all scenes."""

    strategy: str
    """Name of the strategy."""
    seed: int
    """Seed of the run."""
    scenes: tuple[str, ...]
    """Names in order of learning."""
    results: dict[tuple[int, str], SceneResult | PublishedScene]
    """By stage and scene. Joint training has the last stage only."""
    description: Mapping[str, object] = field(default_factory=dict)
    """`Strategy.description`; empty in older results."""

    @property
    def last(self) -> list[SceneResult]:
        """Results of all scenes after the last stage, in order of learning."""
        return [self.end(scene) for scene in self.scenes]

    def end(self, scene: str) -> SceneResult:
        """Return the results of a scene after the last stage."""
        result = self.results[len(self.scenes) - 1, scene]
        assert isinstance(result, SceneResult)
        return result

    @property
    def memory_mb(self) -> float:
        """Megabytes remembered at the end; NaN if the strategy needs all frames again."""
        if self.description.get("jointly"):
            return math.nan
        return self.last[0].memory_bytes / 1e6

    @property
    def seconds(self) -> float:
        """Learning time of all stages."""
        stages = {stage: result.seconds for (stage, _), result in self.results.items()}
        return float(sum(stages.values()))

    def matrix(self, thresholds: tuple[float, float] = COARSE) -> np.ndarray:
        """Return accuracies in per cent, shape (N, N).

        Row i holds the accuracies after stage i, column j those of the scene learned in stage j.
        Entries that were not measured are NaN.
        """
        accuracies = np.full((len(self.scenes), len(self.scenes)), math.nan)
        for (stage, scene), result in self.results.items():
            accuracies[stage, self.scenes.index(scene)] = 100 * result.accuracy(thresholds)
        return accuracies

    def scores(self, thresholds: tuple[float, float] = COARSE) -> ContinualScores:
        """Return final accuracy and forgetting; forgetting is NaN for joint training."""
        matrix = self.matrix(thresholds)
        if not np.isfinite(matrix[np.tril_indices(len(matrix))]).all():
            final, newest = float(matrix[-1].mean()), float(matrix[-1, -1])
            return ContinualScores(final, math.nan, math.nan, math.nan, newest, math.nan)
        return continual_scores(matrix)

    def errors_m(self) -> np.ndarray:
        """Return the translation errors of all test frames at the end, in metres."""
        return np.concatenate([result.translation_m for result in self.last])


def runs_of(
    results: Sequence[SceneResult | PublishedScene],
    strategies: Mapping[str, Mapping[str, object]] | None = None,
) -> list[Run]:
    """Collect the runs whose last stage is complete, in the order of their first lines.

    Args:
        results: All results of a folder.
        strategies: Description of each strategy, by name.

    Raises:
        InputError: No run is complete.
    """
    grouped: dict[tuple[str, int], dict[tuple[int, str], SceneResult | PublishedScene]] = {}
    for result in results:
        run = grouped.setdefault((result.strategy, result.seed), {})
        run[result.stage, result.scene] = result
    count = max((result.stage for result in results), default=-1) + 1
    runs = []
    for (name, seed), stages in grouped.items():
        order = tuple(scene for stage, scene in stages if stage == count - 1)
        if len(order) == count:
            runs.append(Run(name, seed, order, stages, _described(name, strategies or {})))
    if not runs:
        raise InputError("no run is complete; continue with 'evercal bench'")
    return runs


def _described(name: str, strategies: Mapping[str, Mapping[str, object]]) -> Mapping[str, object]:
    """Look up a description; `NAME:network` is the strategy NAME without its map."""
    strategy, _, part = name.partition(":")
    description = strategies.get(strategy, {})
    return {**description, "map": False} if description and f":{part}" == NETWORK else description


def by_strategy(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Group runs by strategy, in the order in which strategies first appear."""
    grouped: dict[str, list[Run]] = {}
    for run in runs:
        grouped.setdefault(run.strategy, []).append(run)
    return grouped


def _median_cm_in_right_scene(run: Run) -> float:
    errors = run.errors_m()
    errors = errors[np.isfinite(errors)]
    return 100 * float(np.median(errors)) if len(errors) else math.nan


def _accuracy_in_right_scene(run: Run) -> float:
    correct = np.concatenate([result.correct() for result in run.last])
    in_right_scene = np.isfinite(run.errors_m())
    return 100 * float(correct[in_right_scene].mean()) if in_right_scene.any() else math.nan


AREA = "area to 20 cm"
METHOD_MEASURES: Measures = {
    "final %": lambda run: run.scores().final_accuracy,
    "1 cm 1 deg %": lambda run: run.scores(FINE).final_accuracy,
    AREA: lambda run: float(np.mean([recall_area(r.translation_m) for r in run.last])),
    "ACC": lambda run: run.scores().accuracy_along,
    "last scene %": lambda run: run.scores().last_scene_accuracy,
    "TFR": lambda run: run.scores().total_forgetting,
    "forgetting": lambda run: run.scores().forgetting,
    "BWT": lambda run: run.scores().backward_transfer,
    "wrong scene %": lambda run: 100 * float(np.mean([np.mean(r.wrong_scene) for r in run.last])),
    "refused %": lambda run: 100 * float(np.mean([np.mean(r.refused) for r in run.last])),
    "in 95 % ellipsoid": lambda run: share_inside(
        np.concatenate([result.squared_mahalanobis for result in run.last])
    ),
    "median cm, right scene": _median_cm_in_right_scene,
    "%, right scene": _accuracy_in_right_scene,
    "memory MB": lambda run: run.memory_mb,
    "heads MB": lambda run: run.last[0].head_bytes / 1e6,
    "s": lambda run: run.seconds,
}
LEGEND = """\
Accuracy: share of all test frames strictly below 5 cm and 5 deg, mean over scenes.
final: accuracy after the last stage. last scene: accuracy on the scene learned last.
area to 20 cm: area under the curve of recall over position error, up to 20 cm, per cent.
ACC: mean accuracy over all stages and the scenes learned by then.
TFR (total forgetting rate): mean drop from the best accuracy of a scene to its final one.
forgetting: the same drop, with the best taken before the last stage; negative is a gain.
BWT (backward transfer): mean change from the accuracy just after learning a scene to the end.
right scene: among frames with a pose in their own scene. s: seconds of learning, all stages.
NAME:network is the network of a run without its map; NAME:unaligned is the pose from matched
keyframes, before landmarks are aligned."""
"""Definitions of the columns of `METHOD_MEASURES`."""


def _threshold_measure(thresholds: tuple[float, float]) -> Callable[[Run], float]:
    return lambda run: run.scores(thresholds).final_accuracy


THRESHOLD_MEASURES: Measures = {
    AREA: METHOD_MEASURES[AREA],
    **{
        f"{100 * metres:.0f} cm {np.rad2deg(radians):.0f} deg": _threshold_measure(
            (metres, radians)
        )
        for metres, radians in (LOOSE, COARSE, MIDDLE, FINE)
    },
}


def measured(runs: Sequence[Run], measures: Measures) -> "DataFrame":
    """Tabulate measures: one row per run, indexed by strategy."""
    import pandas

    rows = [[measure(run) for measure in measures.values()] for run in runs]
    index = pandas.Index([run.strategy for run in runs], name="strategy")
    return pandas.DataFrame(rows, index, columns=list(measures))


def mean_by_strategy(frame: "DataFrame") -> "DataFrame":
    """Average over runs; a mean is NaN if one of its values is."""
    grouped = frame.groupby(level="strategy", sort=False)
    return grouped.agg(lambda column: float(column.to_numpy().mean()))


def as_rows(frame: "DataFrame", digits: int = 1) -> TableRows:
    """Format a table of numbers, the index as its first column; NaN becomes `-`."""
    header = [str(frame.index.name), *map(str, frame.columns)]
    cells = [[number(value, digits) for value in row] for row in frame.to_numpy(float).tolist()]
    return [header, *([str(name), *row] for name, row in zip(frame.index, cells, strict=True))]


def number(value: float, digits: int = 1) -> str:
    """Format a number; NaN becomes `-`."""
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def as_text(rows: TableRows, style: Style = "terminal") -> str:
    """Format a table as text."""
    return table(rows[0], rows[1:], style)


def method_rows(runs: Sequence[Run]) -> TableRows:
    """Tabulate `METHOD_MEASURES`: means over runs, with the spread of the final accuracy."""
    frame = measured(runs, METHOD_MEASURES)
    header, *rows = as_rows(mean_by_strategy(frame))
    final = frame["final %"].groupby(level="strategy", sort=False)
    for row, count, spread in zip(rows, final.size(), final.std(), strict=True):
        row.insert(1, str(count))
        row[2] += f" ± {spread:.1f}" if count > 1 else ""
    return [[header[0], "runs", *header[1:]], *rows]


def threshold_rows(runs: Sequence[Run]) -> TableRows:
    """Tabulate `recall_area` and final accuracy under several thresholds."""
    return as_rows(mean_by_strategy(measured(runs, THRESHOLD_MEASURES)))


def selector_rows(runs: Sequence[Run]) -> TableRows:
    """Tabulate how the remembered frames cover those learned, means over scenes."""
    import pandas

    columns = {
        "frames_kept": "frames kept",
        "covering_radius": "covering radius",
        "min_spacing": "smallest pair",
    }
    results = [
        {"strategy": run.strategy, **{key: getattr(result, key) for key in columns}}
        for run in runs
        for result in run.results.values()
        if math.isfinite(result.covering_radius)
    ]
    if not results:
        return [["strategy", *columns.values()]]
    frame = pandas.DataFrame(results).set_index("strategy").rename(columns=columns)
    rows = as_rows(mean_by_strategy(frame), 2)
    for row in rows[1:]:
        row[1] = f"{float(row[1]):.1f}"
    return rows


def scene_rows(runs: Sequence[Run]) -> TableRows:
    """Tabulate the accuracy of each scene: just after learning it -> at the end."""
    import pandas

    cells = [
        (run.strategy, scene, run.matrix()[i, i], run.matrix()[-1, i])
        for run in runs
        for i, scene in enumerate(run.scenes)
    ]
    frame = pandas.DataFrame(cells, columns=["strategy", "scene", "learned", "end"])
    index = ["strategy", "scene"]
    means = frame.pivot_table(index=index, values=["learned", "end"], sort=False)
    ends = zip(means["learned"], means["end"], strict=True)
    text = pandas.Series([f"{number(a)} -> {number(b)}" for a, b in ends], index=means.index)
    by_scene = text.unstack(sort=False)[sorted(runs[0].scenes)].reset_index()
    return [list(by_scene.columns), *by_scene.to_numpy().tolist()]


def difference_rows(runs: Sequence[Run], reference: str) -> TableRows:
    """Tabulate how much better `reference` ends than each other strategy, on common seeds."""
    grouped = by_strategy(runs)
    rows = [["difference in points", "mean", "95 % low", "95 % high"]]
    for other in grouped:
        interval = difference(grouped.get(reference, []), grouped[other])
        if other != reference and interval is not None:
            bounds = (interval.mean, interval.low, interval.high)
            rows.append([f"{reference} - {other}", *(f"{100 * value:+.1f}" for value in bounds)])
    return rows


def difference(ours: Sequence[Run], theirs: Sequence[Run]) -> Interval | None:
    """Estimate the difference of final accuracies of two strategies, as shares in [-1, 1].

    Returns:
        Mean and 95 % interval over runs of frames and seeds (`mean_interval`). None without a
        common seed, or if a scene has a single test frame.
    """
    pairs = _on_common_seeds(ours, theirs)
    if not pairs:
        return None
    names = sorted(pairs[0][0].scenes)
    pieces = [frame_pieces(pairs[0][0].end(name).frames) for name in names]
    if any(labels[-1] == 0 for labels in pieces):
        return None
    gains = [
        np.array([a.end(name).correct().astype(float) - b.end(name).correct() for a, b in pairs])
        for name in names
    ]
    interval = mean_interval(gains, pieces)
    return Interval(interval.mean, max(interval.low, -1.0), min(interval.high, 1.0))


def _on_common_seeds(ours: Sequence[Run], theirs: Sequence[Run]) -> list[tuple[Run, Run]]:
    return [(a, b) for a in ours for b in theirs if a.seed == b.seed]


def contrast_rows(runs: Sequence[Run], pairs: Sequence[tuple[str, str]]) -> TableRows:
    """Tabulate differences that were named before the runs, on common seeds.

    Final accuracy and `recall_area`, each with the number of runs in which the first is better. The
    intervals are `seeds_interval`, corrected for the number of pairs.
    """
    grouped = by_strategy(runs)
    scores = {name: METHOD_MEASURES[name] for name in ("final %", AREA)}
    heads = [head for score in scores for head in (score, "bounds", "better in")]
    rows = [["contrast, points", "runs", *heads]]
    for ours, theirs in pairs:
        common = list(_on_common_seeds(grouped.get(ours, []), grouped.get(theirs, [])))
        row = [f"{ours} - {theirs}", str(len(common))]
        for score in scores.values():
            gains = [score(a) - score(b) for a, b in common]
            if len(gains) < 2:
                row += ["-"] * 3
                continue
            mean, low, high = seeds_interval(gains, len(pairs))
            better = sum(gain > 0 for gain in gains)
            row += [f"{mean:+.1f}", f"{low:+.1f} to {high:+.1f}", str(better)]
        rows.append(row)
    return rows


def summary(runs: Sequence[Run]) -> dict[str, list[dict[str, object]]]:
    """Summarize every run for JSON, by strategy; NaN becomes None."""
    return {
        name: [
            {
                "seed": run.seed,
                "scenes": list(run.scenes),
                "accuracy_5cm_5deg": _plain(run.matrix().round(3).tolist()),
                "accuracy_1cm_1deg": _plain(run.matrix(FINE).round(3).tolist()),
                **run.scores().to_dict(),
                "memory_bytes": run.last[0].memory_bytes,
                "head_bytes": run.last[0].head_bytes,
                "seconds": run.seconds,
            }
            for run in group
        ]
        for name, group in by_strategy(runs).items()
    }


def _plain(matrix: list[list[float]]) -> list[list[float | None]]:
    return [[None if math.isnan(value) else value for value in row] for row in matrix]
