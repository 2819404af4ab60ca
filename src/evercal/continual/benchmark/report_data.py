"""What a benchmark's results say, computed once for terminal, page and LaTeX."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from evercal.continual.benchmark.ablation import ablation_rows, grid_rows
from evercal.continual.benchmark.comparison import (
    Run,
    TableRows,
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
from evercal.storage import read_settings

PLOTTED = 7


@dataclass(frozen=True)
class Tables:
    """Rows of each table, its header first; a header alone where there is nothing to say."""

    methods: TableRows
    thresholds: TableRows
    scenes: TableRows
    differences: TableRows
    selectors: TableRows
    ablation: TableRows
    grid: TableRows
    compare_with: TableRows

    def non_empty(self) -> list[TableRows]:
        """Those with more than a header."""
        found: list[TableRows] = [getattr(self, part.name) for part in fields(self)]
        return [rows for rows in found if len(rows) > 1]


@dataclass(frozen=True)
class Report:
    """A folder of results, and the same suite under other settings beside it."""

    suite: str
    """Its name."""
    runs: list[Run]
    """Whose last stage is done, those of the strategy that ends best first."""
    reference: str
    """The strategy that the others are compared with."""
    compare_with: list[Run] = field(default_factory=list)
    """Runs of other folders, called `STRATEGY (FOLDER)`."""

    @property
    def plotted(self) -> list[str]:
        """The at most seven strategies of the figures: the reference, then those with most runs."""
        names = sorted(
            by_strategy(self.runs).items(),
            key=lambda item: (item[0] != self.reference, -len(item[1])),  # else the better first
        )
        return [name for name, _ in names[:PLOTTED]]

    def tables(self) -> Tables:
        """Every table."""
        runs = self.runs
        return Tables(
            method_rows(runs),
            threshold_rows(runs),
            scene_rows(runs),
            difference_rows(runs, self.reference),
            selector_rows(runs),
            ablation_rows(runs, self.suite),
            grid_rows(runs),
            method_rows(self.compare_with),
        )


def read_report(folder: Path, reference: str, compare_with: Sequence[Path] = ()) -> Report:
    """Reads results.

    Args:
        folder: of the results.
        reference: the strategy that the others are compared with.
        compare_with: other folders with results of the same scenes, such as under a smaller memory.

    Raises:
        InputError: a folder without results, or with those of other scenes.
    """
    runs, settings = _results(folder)
    others = []
    for other in compare_with:
        found, theirs = _results(other)
        for key in ("suite", "scenes", "judged"):
            if theirs.get(key) != settings.get(key):
                raise InputError(
                    f"{other}: {key} {theirs.get(key)} is not that of {folder}, "
                    f"{settings.get(key)}; only the same frames can be compared"
                )
        others += [replace(run, strategy=f"{run.strategy} ({other.name})") for run in found]
    return Report(str(settings["suite"]), _ranked(runs), reference, _ranked(others))


def _ranked(runs: Sequence[Run]) -> list[Run]:
    final = {
        name: float(np.mean([run.scores().final_accuracy for run in of]))
        for name, of in by_strategy(runs).items()
    }
    return sorted(runs, key=lambda run: -final[run.strategy])


def _results(folder: Path) -> tuple[list[Run], Mapping[str, object]]:
    if not (folder / RESULTS).is_file():
        raise InputError(f"{folder}: no results here; make some with 'evercal bench'")
    return runs_of(read(folder), read_strategies(folder)), read_settings(folder / SETTINGS)
