"""The HTML report of a benchmark."""

from collections.abc import Mapping, Sequence

import numpy as np

from evercal.continual.benchmark.bench_charts import (
    accuracy_against_memory,
    forgetting_curves,
    keyframe_positions,
    scene_bars,
)
from evercal.continual.benchmark.comparison import Run, TableRows, by_strategy
from evercal.continual.benchmark.report_data import TITLES, Report
from evercal.reports.charts import error_curve
from evercal.reports.page import Picture, Table, Tile, render

_TILES = 4
"""Strategies whose accuracy stands beside that of the first."""


def bench_page(
    report: Report,
    tables: Mapping[str, TableRows],
    views: Mapping[str, Sequence[Picture]] | None = None,
) -> str:
    """Write the report.

    Args:
        report: Results.
        tables: Tables of the results.
        views: By scene, a test image and renderings at the estimated poses (`bench_views`).
    """
    every = by_strategy(report.runs)
    plotted = {name: every[name] for name in report.plotted}
    runs = [run for group in plotted.values() for run in group]
    scenes = sorted(runs[0].scenes)
    ends = {
        name: np.mean([_final_accuracies(run, scenes) for run in group], axis=0)
        for name, group in plotted.items()
    }
    omitted = len(every) - len(plotted)
    caption = f"; {omitted} more strategies are in the tables only" if omitted else ""
    errors = {
        name: np.concatenate([end.translation_m for run in group for end in run.last])
        for name, group in plotted.items()
    }
    final = {
        n: f"{np.mean([r.scores().final_accuracy for r in plotted[n]]):.1f} %" for n in plotted
    }
    (name, accuracy), *others = final.items()
    return render(
        "benchmark.html",
        title="evercal bench",
        headline=f"{name}: {accuracy} final accuracy",
        level="",
        first=[Tile(number, f"final accuracy of {other}") for other, number in others[:_TILES]],
        scenes=len(scenes),
        runs=len(plotted[name]),
        tables=dict.fromkeys(TITLES)
        | {name: Table(rows[0], rows[1:]) for name, rows in tables.items()},
        scene_bars=Picture(scene_bars(ends, scenes), f"Final accuracy on each scene{caption}"),
        forgetting=_forgetting(runs),
        views=views or {},
        keyframes=_keyframes(report.runs),
        errors=Picture(error_curve(errors), "Share of frames below each error, all scenes"),
        memory=Picture(_memory(plotted, report), "Final accuracy over memory"),
    )


def _final_accuracies(run: Run, scenes: Sequence[str]) -> list[float]:
    return [100 * float(run.end(name).correct().mean()) for name in scenes]


def _memory(plotted: Mapping[str, Sequence[Run]], report: Report) -> bytes:
    groups = {**plotted, **by_strategy(report.compare_with)}
    return accuracy_against_memory(
        {
            name: (
                float(np.mean([run.memory_mb for run in group])),
                float(np.mean([run.scores().final_accuracy for run in group])),
            )
            for name, group in groups.items()
        }
    )


def _forgetting(runs: Sequence[Run]) -> Picture | None:
    """Mean curves of the strategies; None if the order of scenes differs between runs."""
    if len({run.scenes for run in runs}) > 1:
        return None
    curves = {
        name: np.mean([run.matrix() for run in group], axis=0)
        for name, group in by_strategy(runs).items()
    }
    return Picture(forgetting_curves(curves, runs[0].scenes), "Accuracy while scenes are learned")


def _keyframes(runs: Sequence[Run]) -> list[Picture]:
    """Keyframes of the first run of each strategy; strategies with equal ones share a panel."""
    scenes: dict[str, dict[tuple[tuple[float, float, float], ...], list[str]]] = {}
    for name, group in by_strategy(runs).items():
        for result in group[0].results.values():
            if result.keyframe_positions_m:
                panels = scenes.setdefault(result.scene, {})
                panels.setdefault(result.keyframe_positions_m, []).append(name)
    return [
        Picture(
            keyframe_positions(
                {_label(names): np.array(positions) for positions, names in panels.items()}
            ),
            f"Camera positions of the keyframes of {scene}",
        )
        for scene, panels in scenes.items()
    ]


def _label(names: Sequence[str]) -> str:
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")
