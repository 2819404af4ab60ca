"""`evercal bench-report`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next

TABLES, PAGE, LATEX = "tables.md", "report.html", "table.tex"


@dataclass(frozen=True)
class BenchReport:
    """Generate tables and report of a benchmark from its results.

    Example: evercal bench-report evercal-bench/
    """

    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of results."""
    reference: Annotated[str, arg(metavar="NAME")] = "evercal"
    """Strategy that the others are compared with."""
    compare_with: Annotated[tuple[Path, ...], arg(metavar="DIR...", help_behavior_hint="")] = ()
    """Other folders of results to show, of the same scenes under other settings, such as another
    --memory."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Print and write the tables."""
        return show_report(self.folder, self.reference, self.json, self.compare_with)


def show_report(
    folder: Path, reference: str, as_json: bool, compare_with: tuple[Path, ...] = ()
) -> int:
    """Write tables and page of a folder of results, and print the tables.

    Args:
        folder: Folder of results.
        reference: Strategy that the others are compared with.
        as_json: Print one JSON object instead of the tables.
        compare_with: Other folders of results to show on the page.

    Returns:
        The exit code.
    """
    from evercal.continual.benchmark.bench_page import bench_page
    from evercal.continual.benchmark.bench_views import view_pictures
    from evercal.continual.benchmark.comparison import summary
    from evercal.continual.benchmark.latex import paper_tables
    from evercal.continual.benchmark.report_data import read_report, tables_text
    from evercal.storage import write_bytes

    report = read_report(folder, reference, compare_with)
    tables = report.tables()
    write_bytes(folder / TABLES, (tables_text(tables, "markdown") + "\n").encode())
    views = view_pictures(folder, report.plotted)
    write_bytes(folder / PAGE, bench_page(report, tables, views).encode())
    latex = paper_tables(report.runs, report.suite, tables.get("ablation"))
    write_bytes(folder / LATEX, (latex + "\n").encode())
    if as_json:
        print_json({"strategies": summary([*report.runs, *report.compare_with])})
        return 0
    print(tables_text(tables, "terminal"))
    print(f"wrote {folder / PAGE}, {TABLES} and {LATEX}")
    print_next("evercal", "bench-report", folder)
    return 0
