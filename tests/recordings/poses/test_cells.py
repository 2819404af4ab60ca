"""Cells of text tables: separators, quotation marks, missing cells, decimal commas."""

import csv

import pytest

from evercal.recordings.poses.row_files import table_cells


@pytest.mark.parametrize(
    ("lines", "cells"),
    [
        (["a,b,c", "1, 2 ,3"], [["a", "b", "c"], ["1", "2", "3"]]),
        (["a\tb", "1 x\t2"], [["a", "b"], ["1 x", "2"]]),
        (["a  b", " 1\t 2 ", "\t"], [["a", "b"], ["1", "2"]]),
        (
            ["a;b", "-1,5;,5", "2,5e-1;x,y"],
            [["a", "b"], ["-1.5", ".5"], ["2.5e-1", "x,y"]],
        ),
        # Quotation marks hold separators, line ends and other quotation marks.
        (['a,"b,c"', '"x ""y""",2'], [["a", "b,c"], ['x "y"', "2"]]),
        (['"image file" x', '"a b.png"  1'], [["image file", "x"], ["a b.png", "1"]]),
        (['x,"y', '(m)"', "1,2"], [["x", "y\n(m)"], ["1", "2"]]),
        (['5"', "6"], [['5"'], ["6"]]),
        # Cells may lack at the end of a line, and lines may be empty.
        (
            ["", "a,b,c,,", "1", "", ",,", " , 2"],
            [["a", "b", "c"], ["1", "", ""], ["", "2", ""]],
        ),
        (["", "  "], []),
        ([], []),
    ],
)
def test_cells_of_a_table(lines: list[str], cells: list[list[str]]) -> None:
    assert table_cells(lines).tolist() == cells


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["a,b", "1,2", "", "1,2,3"], "no table: line 4 has 3 cells, not 2"),
        (["a,b", '1,"2', "3,4"], "no table: a quotation mark is not closed"),
        # All lines of a first row count.
        (['a,"b', 'c"' + ",d" * 999], "1,001 columns, at most 1,000 are read"),
        (
            ['a,"b', 'c"' + ",d" * 998, *["1"] * 10_000],
            "10,002,000 cells, at most 10,000,000",
        ),
    ],
)
def test_other_text_is_no_table(lines: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        table_cells(lines)


def test_long_cells_are_named_whatever_the_limit_of_the_csv_module() -> None:
    before = csv.field_size_limit(10)
    try:
        with pytest.raises(
            ValueError, match="row 2, column 1: 300,000 characters, at most 1,000"
        ):
            table_cells(["a,b", "x" * 300_000 + ",1"])
    finally:
        csv.field_size_limit(before)
