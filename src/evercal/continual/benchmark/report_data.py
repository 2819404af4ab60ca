"""The contents of a benchmark report: its runs and tables, shared by terminal, page and LaTeX."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from evercal.continual.benchmark.ablation import ablation_rows, grid_rows
from evercal.continual.benchmark.comparison import (
    LEGEND,
    Run,
    TableRows,
    as_text,
    by_strategy,
    difference_rows,
    method_rows,
    runs_of,
    scene_rows,
    selector_rows,
    threshold_rows,
)
from evercal.continual.benchmark.results import RESULTS, SETTINGS, read, read_strategies
from evercal.errors import InputError
from evercal.evaluation.tables import Style
from evercal.storage.settings import read_settings

PLOTTED = 7


TITLES = {
    "methods": "Strategies, means over runs",
    "thresholds": "Final accuracy in per cent, by threshold",
    "scenes": "Accuracy of each scene: just after learning it -> at the end",
    "differences": "Differences of final accuracy; the interval excludes 0 if a difference is real",
    "selectors": "Remembered frames, in scene sides and radians",
    "ablation": "Ablation after Table 4 of the paper",
    "grid": "Final accuracy (TFR), by remembered frames and cost of replay",
    "compare_with": "The same scenes under other settings",
}
"""Titles of the tables of a report, by name."""


def tables_text(tables: Mapping[str, TableRows], style: Style) -> str:
    """Format all tables, each below its title, with the definitions of the columns."""
    title = "## {}" if style == "markdown" else "{}"
    parts = [
        f"{title.format(TITLES[name])}\n\n{as_text(rows, style)}" for name, rows in tables.items()
    ]
    return "\n\n".join([*parts, LEGEND])


@dataclass(frozen=True)
class Report:
    """Runs of a folder of results, and runs of the same suite under other settings."""

    suite: str
    """Name of the suite."""
    runs: list[Run]
    """Complete runs, best strategy first."""
    reference: str
    """Strategy that the others are compared with."""
    compare_with: list[Run] = field(default_factory=list)
    """Runs of other folders, named `STRATEGY (FOLDER)`."""

    @property
    def plotted(self) -> list[str]:
        """At most seven strategies for figures: the reference, then those with most runs."""
        groups = sorted(
            by_strategy(self.runs).items(),
            key=lambda item: (item[0] != self.reference, -len(item[1])),
        )
        return [name for name, _ in groups[:PLOTTED]]

    def tables(self) -> dict[str, TableRows]:
        """Compute the tables that have results, by the names of `TITLES`; headers first."""
        tables = {
            "methods": method_rows(self.runs),
            "thresholds": threshold_rows(self.runs),
            "scenes": scene_rows(self.runs),
            "differences": difference_rows(self.runs, self.reference),
            "selectors": selector_rows(self.runs),
            "ablation": ablation_rows(self.runs, self.suite),
            "grid": grid_rows(self.runs),
            "compare_with": method_rows(self.compare_with) if self.compare_with else [],
        }
        return {name: rows for name, rows in tables.items() if len(rows) > 1}


def read_report(folder: Path, reference: str, compare_with: Sequence[Path] = ()) -> Report:
    """Read results.

    Args:
        folder: Folder of results.
        reference: Strategy that the others are compared with.
        compare_with: Other folders with results of the same scenes.

    Raises:
        InputError: A folder has no results, or results of other scenes.
    """
    runs, settings = _results(folder)
    others = []
    for other in compare_with:
        more, theirs = _results(other)
        for key in ("suite", "scenes", "judged"):
            if theirs.get(key) != settings.get(key):
                raise InputError(
                    f"{other}: {key} is {theirs.get(key)}, but {settings.get(key)} in {folder};"
                    " compare results of the same frames"
                )
        others += [replace(run, strategy=f"{run.strategy} ({other.name})") for run in more]
    return Report(str(settings["suite"]), _ranked(runs), reference, _ranked(others))


def _ranked(runs: Sequence[Run]) -> list[Run]:
    final = {
        name: float(np.mean([run.scores().final_accuracy for run in group]))
        for name, group in by_strategy(runs).items()
    }
    return sorted(runs, key=lambda run: -final[run.strategy])


def _results(folder: Path) -> tuple[list[Run], dict[str, object]]:
    if not (folder / RESULTS).is_file():
        raise InputError(f"{folder}: no results here; make some with 'evercal bench'")
    return runs_of(read(folder), read_strategies(folder)), dict(read_settings(folder / SETTINGS))
