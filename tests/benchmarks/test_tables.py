"""Every table of the pages that results/ can print has the numbers of the data."""

import re

import pytest

from benchmarks.tables import FOLDER, TABLES, markdown


def cells(line: str) -> list[str]:
    """Cells of a line of a table, without emphasis."""
    return [cell.strip().strip("*") for cell in line.strip().strip("|").split("|")]


@pytest.mark.parametrize("name", TABLES)
def test_pages_have_the_numbers_of_the_data(name: str) -> None:
    page = name.partition(":")[0]
    folder = FOLDER.parent / ("docs" if page in ("results", "scale") else "research")
    text = (folder / f"{page}.md").read_text()
    lines = [cells(line) for line in text.splitlines() if line.startswith("|")]
    header, _, *rows = (cells(line) for line in markdown(TABLES[name]()).splitlines())
    assert header in lines
    assert [row for row in rows if row not in lines] == []
    # The rows stand together, with no other among them.
    start = lines.index(rows[0])
    assert lines[start - 2] == header
    assert lines[start : start + len(rows)] == rows


def test_pages_have_no_marks_of_generated_tables() -> None:
    for page in (
        FOLDER.parent / "docs" / "results.md",
        *FOLDER.parent.glob("research/*.md"),
    ):
        assert not re.search("<!-- (table|end)", page.read_text())
