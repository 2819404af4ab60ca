"""`evercal bench-report`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next

TABLES, PAGE, LATEX = "tables.md", "report.html", "table.tex"


@dataclass(frozen=True)
class BenchReport:
    """Make tables and report of a benchmark anew from its results."""

    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of results."""
    reference: Annotated[str, arg(metavar="NAME")] = "evercal"
    """Name of the strategy that the others are compared with."""
    compare_with: Annotated[tuple[Path, ...], arg(metavar="DIR...", help_behavior_hint="")] = ()
    """Other folders of results to show beside it, of the same scenes under other settings, such as
    another --memory."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Prints and writes the tables."""
        return show_report(self.folder, self.reference, self.json, self.compare_with)


def show_report(
    folder: Path, reference: str, as_json: bool, compare_with: tuple[Path, ...] = ()
) -> int:
    """Writes tables and page of a folder of results, prints the tables, and gives the exit code.

    Args:
        folder: results.
        reference: the strategy that the others are compared with.
        as_json: print one JSON object instead.
        compare_with: other folders of results to show in the page.
    """
    from evercal.continual.benchmark.bench_page import bench_page
    from evercal.continual.benchmark.bench_views import view_pictures
    from evercal.continual.benchmark.comparison import as_text, summary
    from evercal.continual.benchmark.latex import paper_tables
    from evercal.continual.benchmark.report_data import read_report
    from evercal.simulation.cell import SUITES
    from evercal.storage import write_bytes

    report = read_report(folder, reference, compare_with)
    tables = report.tables()

    def text(style: Literal["terminal", "markdown"]) -> str:
        return "\n\n".join(as_text(rows, style) for rows in tables.non_empty())

    write_bytes(folder / TABLES, (text("markdown") + "\n").encode())
    suite = SUITES.get(report.suite)
    rooms = {name: (kind, seed) for name, kind, seed in suite.rooms} if suite else {}
    views = view_pictures(folder, report.plotted, rooms)
    write_bytes(folder / PAGE, bench_page(report, tables, views).encode())
    latex = paper_tables(report.runs, report.suite, tables.ablation)
    write_bytes(folder / LATEX, (latex + "\n").encode())
    if as_json:
        print_json({"strategies": summary([*report.runs, *report.compare_with])})
        return 0
    print(text("terminal"))
    print(f"wrote {folder / PAGE}, {TABLES} and {LATEX}")
    print_next("evercal", "bench-report", folder)
    return 0
