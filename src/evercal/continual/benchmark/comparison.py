"""What the outcomes of a benchmark say: one row per method, and whether differences are real."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from evercal.continual.benchmark.published import LOOSE, PublishedScene
from evercal.continual.benchmark.results import NETWORK, SceneResult
from evercal.continual.benchmark.statistics import Interval, frame_pieces, paired_difference
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

BOUNDS = (LOOSE, COARSE, MIDDLE, FINE)
"""Metres and radians under which accuracy is asked."""

TableRows = list[list[str]]
"""A table's cells, its header first."""


@dataclass(frozen=True)
class Run:
    """One strategy with one seed, its whole sequence done."""

    strategy: str
    """Which strategy."""
    seed: int
    """Which seed."""
    scenes: tuple[str, ...]
    """In order of learning."""
    results: dict[tuple[int, str], SceneResult | PublishedScene]
    """By stage and scene, the last stage frame by frame; joint training has the last alone."""
    description: Mapping[str, object] = field(default_factory=dict)
    """What the strategy is (`Strategy.description`); empty in older results."""

    @property
    def last(self) -> list[SceneResult]:
        """What is known of every scene at the end, in order of learning."""
        return [self.end(scene) for scene in self.scenes]

    def end(self, scene: str) -> SceneResult:
        """What is known of one scene at the end."""
        found = self.results[len(self.scenes) - 1, scene]
        assert isinstance(found, SceneResult)
        return found

    @property
    def memory_mb(self) -> float:
        """Megabytes that stay of the scenes at the end; NaN where all frames are needed again."""
        if self.description.get("jointly"):
            return math.nan
        return self.last[0].memory_bytes / 1e6

    def matrix(self, thresholds: tuple[float, float] = COARSE) -> np.ndarray:
        """(N, N) accuracies in per cent: row i after stage i, column j the scene of stage j.

        NaN where a scene was not yet learned, and before the last stage of joint training.
        """
        count = len(self.scenes)
        found = np.full((count, count), math.nan)
        for (stage, scene), result in self.results.items():
            column = self.scenes.index(scene)
            found[stage, column] = 100 * result.accuracy(thresholds)
        return found

    def scores(self, thresholds: tuple[float, float] = COARSE) -> ContinualScores:
        """Final accuracy and forgetting; the latter NaN for joint training."""
        matrix = self.matrix(thresholds)
        if not np.isfinite(matrix[np.tril_indices(len(matrix))]).all():
            final, newest = float(matrix[-1].mean()), float(matrix[-1, -1])
            return ContinualScores(final, math.nan, math.nan, math.nan, newest, math.nan)
        return continual_scores(matrix)


def runs_of(
    results: Sequence[SceneResult | PublishedScene],
    strategies: Mapping[str, Mapping[str, object]] | None = None,
) -> list[Run]:
    """The runs whose last stage is done, in the order of their first lines.

    Args:
        results: of a folder.
        strategies: what each strategy is, by name.

    Raises:
        InputError: no run is done.
    """
    grouped: dict[tuple[str, int], dict[tuple[int, str], SceneResult | PublishedScene]] = {}
    for result in results:
        run = grouped.setdefault((result.strategy, result.seed), {})
        run[result.stage, result.scene] = result
    count = max((result.stage for result in results), default=-1) + 1
    found = []
    for (strategy, seed), of in grouped.items():
        order = tuple(scene for stage, scene in of if stage == count - 1)
        if len(order) == count:
            found.append(Run(strategy, seed, order, of, _described(strategy, strategies or {})))
    if not found:
        raise InputError("no run is done yet; go on with 'evercal bench'")
    return found


def _described(name: str, strategies: Mapping[str, Mapping[str, object]]) -> Mapping[str, object]:
    """What a row is; one that judges the network of a run alone is that without its map."""
    of, _, judged = name.partition(":")
    found = strategies.get(of, {})
    return {**found, "map": False} if found and f":{judged}" == NETWORK else found


def as_text(rows: TableRows, style: Style = "terminal") -> str:
    """A table as text."""
    return table(rows[0], rows[1:], style)


def method_rows(runs: Sequence[Run]) -> TableRows:
    """One row per strategy: means over seeds, and the spread of the first column."""
    rows = [["strategy", "runs", *(name for name, _ in _COLUMNS)]]
    for name, of in by_strategy(runs).items():
        first = [_COLUMNS[0][1](run) for run in of]
        spread = f" ± {np.std(first, ddof=1):.1f}" if len(of) > 1 else ""
        cells = [_mean([value(run) for run in of]) for _, value in _COLUMNS]
        rows.append([name, str(len(of)), cells[0] + spread, *cells[1:]])
    return rows


def threshold_rows(runs: Sequence[Run]) -> TableRows:
    """One row per strategy: `recall_area` at the end and accuracy under several bounds."""
    bounds = [f"{100 * m:.0f} cm {np.rad2deg(r):.0f} deg" for m, r in BOUNDS]
    rows = [["strategy", "area to 20 cm", *bounds]]
    for name, of in by_strategy(runs).items():
        areas = [recall_area(scene.translation_m) for run in of for scene in run.last]
        shares = [_mean([run.scores(bound).final_accuracy for run in of]) for bound in BOUNDS]
        rows.append([name, _mean(areas), *shares])
    return rows


def selector_rows(runs: Sequence[Run]) -> TableRows:
    """One row per strategy that keeps frames: how they lie among those learned, mean of scenes."""
    rows = [["strategy", "frames kept", "covering radius", "smallest pair"]]
    for name, of in by_strategy(runs).items():
        told = [o for run in of for o in run.results.values() if math.isfinite(o.covering_radius)]
        if told:
            cells = [
                np.mean([getattr(o, key) for o in told])
                for key in ("covering_radius", "min_spacing")
            ]
            frames = f"{np.mean([o.frames_kept for o in told]):.1f}"
            rows.append([name, frames, *(f"{value:.2f}" for value in cells)])
    return rows


def scene_rows(runs: Sequence[Run]) -> TableRows:
    """One row per strategy, a column per scene: accuracy when learned and at the end."""
    names = sorted(runs[0].scenes)
    rows = [["strategy", *names]]
    for strategy, of in by_strategy(runs).items():
        cells = []
        for name in names:
            matrices = [(run.matrix(), run.scenes.index(name)) for run in of]
            learned = _mean([matrix[i, i] for matrix, i in matrices])
            cells.append(f"{learned} -> {_mean([matrix[-1, i] for matrix, i in matrices])}")
        rows.append([strategy, *cells])
    return rows


def difference_rows(runs: Sequence[Run], reference: str) -> TableRows:
    """How much better `reference` ends than each other strategy, on the seeds that both ran.

    Bounds are those of `evaluation.paired_difference` over whole runs of frames and over seeds.
    """
    grouped = by_strategy(runs)
    rows = [["difference in points", "mean", "95 % low", "95 % high"]]
    for other, of in grouped.items():
        if other == reference or reference not in grouped:
            continue
        d = difference(grouped[reference], of)
        if d is not None:
            cells = [f"{100 * value:+.1f}" for value in (d.mean, d.low, d.high)]
            rows.append([f"{reference} - {other}", *cells])
    return rows


def difference(ours: Sequence[Run], theirs: Sequence[Run]) -> Interval | None:
    """Final accuracy of one strategy less that of another, and 95 % bounds, both within -1 to 1.

    None without a common seed, or where a scene has one test frame, of whose choice nobody can say
    how much it matters.
    """
    pairs = [(a, b) for a in ours for b in theirs if a.seed == b.seed]
    if not pairs:
        return None
    names = sorted(pairs[0][0].scenes)

    def flags(which: int, name: str) -> np.ndarray:
        ends = [pair[which].end(name) for pair in pairs]
        return np.array([end.correct() for end in ends], float)

    pieces = [frame_pieces(pairs[0][0].end(name).frames) for name in names]
    if not all(of[-1] > 0 for of in pieces):
        return None
    first, second = ([flags(which, name) for name in names] for which in (0, 1))
    found = paired_difference(first, second, pieces)
    return Interval(found.mean, max(found.low, -1.0), min(found.high, 1.0))


def by_strategy(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs grouped, strategies in the order in which they first appear."""
    grouped: dict[str, list[Run]] = {}
    for run in runs:
        grouped.setdefault(run.strategy, []).append(run)
    return grouped


def summary(runs: Sequence[Run]) -> dict[str, object]:
    """Everything above for JSON; None where there is no number."""
    found = {}
    for name, of in by_strategy(runs).items():
        found[name] = [
            {
                "seed": run.seed,
                "scenes": list(run.scenes),
                "accuracy_5cm_5deg": _plain(run.matrix()),
                "accuracy_1cm_1deg": _plain(run.matrix(FINE)),
                **{k: _plain(v) for k, v in asdict(run.scores()).items()},
                "memory_bytes": run.last[0].memory_bytes,
                "head_bytes": run.last[0].head_bytes,
                "seconds": _seconds(run),
            }
            for run in of
        ]
    return found


def _fine_median_cm(run: Run) -> float:
    """Median error among frames that were given the right scene: what is lost within a scene."""
    errors = np.concatenate([o.translation_m for o in run.last])
    right = errors[np.isfinite(errors)]
    return 100 * float(np.median(right)) if len(right) else math.nan


def _fine_accuracy(run: Run) -> float:
    """Accuracy among frames that were given the right scene."""
    right = np.concatenate([np.isfinite(o.translation_m) for o in run.last])
    correct = np.concatenate([o.correct() for o in run.last])
    return 100 * float(correct[right].mean()) if right.any() else math.nan


def _wrong_scene(run: Run) -> float:
    return 100 * float(np.mean([np.mean(o.wrong_scene) for o in run.last]))


def _refused(run: Run) -> float:
    return 100 * float(np.mean([np.mean(o.refused) for o in run.last]))


def _inside(run: Run) -> float:
    """Per cent of all poses in the right scene that lie in the ellipsoid stated for them."""
    return share_inside(np.concatenate([o.squared_mahalanobis for o in run.last]))


def _seconds(run: Run) -> float:
    stages = {stage: result.seconds for (stage, _), result in run.results.items()}
    return float(sum(stages.values()))


_COLUMNS: tuple[tuple[str, Callable[[Run], float]], ...] = (
    ("final %", lambda run: run.scores().final_accuracy),
    ("1 cm 1 deg %", lambda run: run.scores(FINE).final_accuracy),
    ("ACC", lambda run: run.scores().accuracy_along),
    ("last scene %", lambda run: run.scores().last_scene_accuracy),
    ("TFR", lambda run: run.scores().total_forgetting),
    ("forgetting", lambda run: run.scores().forgetting),
    ("BWT", lambda run: run.scores().backward_transfer),
    ("wrong scene %", _wrong_scene),
    ("refused %", _refused),
    ("in 95 % ellipsoid", _inside),
    ("median cm, right scene", _fine_median_cm),
    ("%, right scene", _fine_accuracy),
    ("memory MB", lambda run: run.memory_mb),
    ("heads MB", lambda run: run.last[0].head_bytes / 1e6),
    ("s", _seconds),
)


def _mean(values: Sequence[float]) -> str:
    value = float(np.mean(values))
    return "-" if math.isnan(value) else f"{value:.1f}"


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return [[None if math.isnan(v) else round(v, 3) for v in row] for row in value.tolist()]
    return None if isinstance(value, float) and math.isnan(value) else value
