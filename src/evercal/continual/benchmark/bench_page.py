"""The report of a benchmark: tables and figures in one HTML file."""

from collections.abc import Mapping, Sequence

import numpy as np

from evercal.continual.benchmark.comparison import Run, TableRows, by_strategy
from evercal.continual.benchmark.report_data import Report, Tables
from evercal.reports import (
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


def bench_page(report: Report, tables: Tables, pictures: Sequence[Picture] = ()) -> str:
    """The whole page.

    Args:
        report: results.
        tables: what they say.
        pictures: what the methods see (`bench_views`).
    """
    every = by_strategy(report.runs)
    grouped = {name: every[name] for name in report.plotted}
    runs = [run for of in grouped.values() for run in of]
    left = len(every) - len(grouped)
    more = f"; {left} more strategies are in the tables alone" if left else ""
    sections = [_methods(tables), _scenes(grouped, sorted(runs[0].scenes), tables, more)]
    curves = _curves(runs)
    if curves:
        drawing = forgetting_curves(curves, runs[0].scenes)
        sections.append(Section("Forgetting", [Picture(drawing, "What became of each scene")]))
    if pictures:
        said = "A test image of each scene, and the scene at the pose that each method found for it"
        sections.append(Section("At the end, seen from the estimated pose", [said, *pictures]))
    sections += [*_what_stays(report, tables), *_parts(tables), *_differences(tables)]
    sections.append(_errors_and_memory(grouped, report, tables))
    return html_page("evercal bench", sections)


def _methods(tables: Tables) -> Section:
    means = _table(tables.methods, "Means over runs; accuracy in per cent")
    bounds = _table(tables.thresholds, "At the end, under looser and tighter bounds")
    return Section("Methods", [means, bounds])


def _scenes(
    grouped: Mapping[str, Sequence[Run]], names: Sequence[str], tables: Tables, more: str
) -> Section:
    ends = {
        name: np.mean([_ends(run, names) for run in of], axis=0) for name, of in grouped.items()
    }
    said = "Test frames within 5 cm and 5 deg: when learned, at the end"
    picture = Picture(scene_bars(ends, names), f"At the end{more}")
    return Section("Scenes", [_table(tables.scenes, said), picture])


def _what_stays(report: Report, tables: Tables) -> list[Section]:
    kept = _kept(report.runs)
    if not kept:
        return []
    table = _table(tables.selectors, "In the metric of SARS: scene sides and radians")
    places = [
        Picture(kept_places(of), f"Remembered cameras of {scene}") for scene, of in kept.items()
    ]
    return [Section("What stays", [table, *places])]


def _parts(tables: Tables) -> list[Section]:
    parts = [
        _table(rows, said)
        for rows, said in (
            (tables.ablation, "After the paper's Table 4; 95 % bounds as below"),
            (tables.grid, "Final accuracy (TFR) by which frames stay and what replay costs"),
        )
        if len(rows) > 1
    ]
    return [Section("What each part gives", parts)] if parts else []


def _differences(tables: Tables) -> list[Section]:
    if len(tables.differences) <= 1:
        return []
    said = "95 % bounds over runs and pieces of recording; real where 0 lies outside."
    return [Section("Differences", [_table(tables.differences, said)])]


def _errors_and_memory(
    grouped: Mapping[str, Sequence[Run]], report: Report, tables: Tables
) -> Section:
    sizes = {
        name: (
            float(np.mean([run.memory_mb for run in of])),
            float(np.mean([run.scores().final_accuracy for run in of])),
        )
        for name, of in {**grouped, **by_strategy(report.compare_with)}.items()
    }
    errors = {
        name: np.concatenate([o.translation_m for run in of for o in run.last])
        for name, of in grouped.items()
    }
    parts: list[str | Table | Picture] = [
        Picture(error_curve(errors), "All scenes at the end"),
        Picture(accuracy_against_size(sizes, "memory"), "What accuracy takes"),
    ]
    if report.compare_with:
        parts.append(_table(tables.compare_with, "The same scenes under other settings"))
    return Section("Errors and memory", parts)


def _ends(run: Run, names: Sequence[str]) -> list[float]:
    return [100 * float(run.end(name).correct().mean()) for name in names]


def _curves(runs: Sequence[Run]) -> dict[str, np.ndarray]:
    """Mean matrices of the strategies if the order of scenes is the same in all runs."""
    if len({run.scenes for run in runs}) > 1:
        return {}
    return {
        name: np.mean([run.matrix() for run in of], axis=0)
        for name, of in by_strategy(runs).items()
    }


def _kept(runs: Sequence[Run]) -> dict[str, dict[str, np.ndarray]]:
    """For each scene the remembered camera positions of the strategies' first runs.

    Those that keep the same frames are named together.
    """
    same: dict[str, dict[tuple[tuple[float, float, float], ...], list[str]]] = {}
    for name, of in by_strategy(runs).items():
        for result in of[0].results.values():
            if result.keyframe_positions_m:
                same.setdefault(result.scene, {}).setdefault(
                    result.keyframe_positions_m, []
                ).append(name)
    return {
        scene: {_together(names): np.array(places) for places, names in of.items()}
        for scene, of in same.items()
    }


def _together(names: Sequence[str]) -> str:
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")


def _table(rows: TableRows, caption: str) -> Table:
    header, *body = rows
    return Table(header, body, caption)
