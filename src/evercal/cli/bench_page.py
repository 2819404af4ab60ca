"""The report of a benchmark: tables and figures in one HTML file."""

from collections.abc import Sequence

import numpy as np

from evercal.drawing import (
    Picture,
    Section,
    Table,
    accuracy_against_size,
    error_curve,
    forgetting_curves,
    html_page,
    kept_places,
    scene_bars,
)
from evercal.evaluation.ablation import ablation_rows, grid_rows
from evercal.evaluation.comparison import (
    Rows,
    Run,
    by_strategy,
    difference_rows,
    method_rows,
    scene_rows,
    selector_rows,
    threshold_rows,
)


def bench_page(
    runs: Sequence[Run], reference: str, suite: str = "", pictures: Sequence[Picture] = ()
) -> str:
    """The whole page.

    Args:
        runs: whose last stage is done.
        reference: the strategy that others are compared with.
        suite: its name.
        pictures: what the methods see (`bench_views`).
    """
    grouped = by_strategy(runs)
    names = sorted(runs[0].scenes)
    ends = {
        name: np.mean([_ends(run, names) for run in of], axis=0) for name, of in grouped.items()
    }
    sizes = {
        name: (float(np.mean([r.last[0].memory_bytes for r in of])) / 1e6, float(ends[name].mean()))
        for name, of in grouped.items()
    }
    errors = {
        name: np.concatenate([o.translation_m for run in of for o in run.last])
        for name, of in grouped.items()
    }
    sections = [
        Section(
            "Methods",
            [
                _table(method_rows(runs), "Means over runs; accuracy in per cent"),
                _table(threshold_rows(runs), "At the end, under looser and tighter bounds"),
            ],
        ),
        Section(
            "Scenes",
            [
                _table(
                    scene_rows(runs), "Test frames within 5 cm and 5 deg: when learned, at the end"
                ),
                Picture(scene_bars(ends, names), "At the end"),
            ],
        ),
    ]
    curves = _curves(runs)
    if curves:
        order = runs[0].scenes
        sections.append(
            Section(
                "Forgetting",
                [Picture(forgetting_curves(curves, order), "What became of each scene")],
            )
        )
    if pictures:
        said = "A test image of each scene, and the scene at the pose that each method found for it"
        sections.append(Section("At the end, seen from the estimated pose", [said, *pictures]))
    kept = _kept(runs)
    if kept:
        sections.append(
            Section(
                "What stays",
                [
                    _table(selector_rows(runs), "In the metric of SARS: scene sides and radians"),
                    *(
                        Picture(kept_places(of), f"Remembered cameras of {scene}")
                        for scene, of in kept.items()
                    ),
                ],
            )
        )
    parts = [
        _table(rows, said)
        for rows, said in (
            (
                ablation_rows(runs, suite),
                "After the paper's Table 4; bounds of a paired bootstrap",
            ),
            (grid_rows(runs), "Final accuracy (TFR) by which frames stay and what replay costs"),
        )
        if len(rows) > 1
    ]
    if parts:
        sections.append(Section("What each part gives", parts))
    if len(grouped) > 1:
        said = "Paired bootstrap over runs and blocks of 10 frames; real where 0 lies outside."
        sections.append(Section("Differences", [_table(difference_rows(runs, reference), said)]))
    sections.append(
        Section(
            "Errors and memory",
            [
                Picture(error_curve(errors), "All scenes at the end"),
                Picture(accuracy_against_size(sizes, "memory"), "What accuracy takes"),
            ],
        )
    )
    return html_page("evercal bench", sections)


def _ends(run: Run, names: Sequence[str]) -> list[float]:
    return [100 * float(run.end(name).correct().mean()) for name in names]


def _curves(runs: Sequence[Run]) -> dict[str, np.ndarray]:
    """Mean matrices of strategies that were judged after every stage, if the order is the same."""
    if len({run.scenes for run in runs}) > 1:
        return {}
    found = {}
    for name, of in by_strategy(runs).items():
        matrix = np.mean([run.matrix() for run in of], axis=0)
        if np.isfinite(matrix[np.tril_indices(len(matrix))]).all():
            found[name] = matrix
    return found


def _kept(runs: Sequence[Run]) -> dict[str, dict[str, np.ndarray]]:
    """For each scene the remembered camera positions of each strategy's first run."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for name, of in by_strategy(runs).items():
        for outcome in of[0].outcomes.values():
            if outcome.kept_m:
                found.setdefault(outcome.scene, {})[name] = np.array(outcome.kept_m)
    return found


def _table(rows: Rows, caption: str) -> Table:
    header, *body = rows
    return Table(header, body, caption)
