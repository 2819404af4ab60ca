"""Reports are well-formed and self-contained; all values are escaped."""

import base64
from dataclasses import dataclass

import numpy as np
import pytest

from evercal.reports.overlay import encode_image
from evercal.reports.page import Picture, Table, render

from .html_reader import HtmlReader

PNG = encode_image(np.zeros((2, 3, 3), np.uint8))
JPG = encode_image(np.zeros((2, 3, 3), np.uint8), "jpg")
MARKUP = "<script>alert(\"1\")</script> & 'x'"


def page(table: Table, picture: Picture, title: str = "title") -> str:
    """A report with one table and one picture, through the template of `evercal bench`."""
    tables = dict.fromkeys(["thresholds", "scenes", "ablation", "grid", "differences"])
    return render(
        "benchmark.html",
        title=title,
        headline=title,
        level="",
        first=[],
        scenes=1,
        runs=1,
        tables={"methods": table, **tables},
        scene_bars=picture,
        errors=picture,
        memory=picture,
        forgetting=None,
        views={},
        keyframes=[],
    )


def test_values_are_escaped() -> None:
    reader = HtmlReader(page(Table([MARKUP], [[MARKUP]], MARKUP), Picture(PNG, MARKUP), MARKUP))
    for tag in ("title", "h1", "th", "td", "caption"):
        assert reader.text(tag) == MARKUP, tag
    assert reader.text("figcaption").splitlines() == [MARKUP] * 3
    assert "script" not in reader.tags
    assert [image["alt"] for image in reader.images] == [MARKUP] * 3


@pytest.mark.parametrize(("data", "kind"), [(PNG, "png"), (JPG, "jpeg")])
def test_pictures_are_embedded(data: bytes, kind: str) -> None:
    source = HtmlReader(page(Table([], []), Picture(data))).images[0]["src"] or ""
    head, _, body = source.partition(",")
    assert head == f"data:image/{kind};base64"
    assert base64.b64decode(body) == data


def test_report_refers_to_no_other_file() -> None:
    text = page(Table(["a"], [[1]]), Picture(PNG))
    for reference in ("http://", "https://", "url(", "href", "<link", "<script"):
        assert reference not in text
    assert "default-src 'none'" in text
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


def test_columns_of_numbers_are_aligned_right() -> None:
    rows = [["chess", 97.5, "12 ± 1", "-"], ["stairs", "inf", 3, "7.1"]]
    reader = HtmlReader(page(Table(["scene", "accuracy", "share", "mm"], rows), Picture(PNG)))
    assert reader.numeric == [[False, True, True, True]] * 3
    assert reader.rows[1] == ["chess", "97.5", "12 ± 1", "-"]


def test_columns_without_values_are_hidden() -> None:
    table = Table(["scene", "reason", "mm"], [["a", "", "-"], ["b", "-", "2.0"]])
    assert HtmlReader(page(table, Picture(PNG))).rows == [["scene", "mm"], ["a", "-"], ["b", "2.0"]]
    assert Table(["a", "b"], []).columns == [0, 1]


def test_records_are_rows() -> None:
    @dataclass
    class Record:
        room: str
        images_used: int
        error_mm: float | None
        error_deg: float
        moved: bool

    table = Table.of_records(
        [Record("a", 3, 1.234, 0.0567, True), Record("b", 0, None, 1.0, False)]
    )
    assert list(table.header) == ["room", "images used", "error mm", "error deg", "moved"]
    assert table.rows == [["a", "3", "1.23", "0.057", "yes"], ["b", "0", "-", "1.000", "no"]]
