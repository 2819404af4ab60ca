"""Reports are well-formed and self-contained; all values are escaped."""

import base64
from dataclasses import dataclass

import cv2
import jinja2
import numpy as np
import pytest

from evercal.reports.charts import INKS
from evercal.reports.page import Picture, Table, environment, render

from .html_reader import HtmlReader

PHOTO = np.full((20, 30, 3), (200, 100, 50), np.uint8)
MARKUP = "<script>alert(\"1\")</script> & 'x'"
TEMPLATE = """{% extends "base.html" %}{% from "blocks.html" import table, picture %}
{% block content %}{{ table(content) }}{{ picture(photo) }}{% endblock %}"""


def page(table: Table, picture: Picture, title: str = "title") -> str:
    """A report with one table and one picture."""
    values = {"title": title, "headline": title, "level": "", "first": []}
    template = environment().from_string(TEMPLATE)
    return template.render(content=table, photo=picture, inks=INKS, **values)


def test_values_are_escaped() -> None:
    reader = HtmlReader(
        page(Table([MARKUP], [[MARKUP]], MARKUP), Picture(PHOTO, MARKUP), MARKUP)
    )
    for tag in ("title", "h1", "th", "td", "caption", "figcaption"):
        assert reader.text(tag) == MARKUP, tag
    assert "script" not in reader.tags
    assert [image["alt"] for image in reader.images] == [MARKUP]


def test_undefined_names_raise() -> None:
    with pytest.raises(jinja2.UndefinedError, match="headline"):
        render("base.html", title="title", level="", first=[])


def test_pictures_are_embedded() -> None:
    source = HtmlReader(page(Table([], []), Picture(PHOTO))).images[0]["src"] or ""
    head, _, body = source.partition(",")
    assert head == "data:image/jpeg;base64"
    read = cv2.imdecode(
        np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR
    )
    assert read is not None
    assert np.abs(read[..., ::-1].astype(int) - PHOTO).max() < 6


def test_report_refers_to_no_other_file() -> None:
    text = page(Table(["a"], [[1]]), Picture(PHOTO))
    for reference in ("http://", "https://", "url(", "href", "<link", "<script"):
        assert reference not in text
    assert "default-src 'none'" in text


def test_columns_of_numbers_are_aligned_right_and_empty_ones_hidden() -> None:
    rows = [["chess", 97.5, "12 ± 1", "-", ""], ["stairs", "inf", 3, "7.1", "-"]]
    header = ["scene", "accuracy", "share", "mm", "reason"]
    reader = HtmlReader(page(Table(header, rows), Picture(PHOTO)))
    assert reader.numeric == [[False, True, True, True]] * 3
    assert reader.rows[1] == ["chess", "97.5", "12 ± 1", "-"]
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
    assert list(table.header) == [
        "room",
        "images used",
        "error mm",
        "error deg",
        "moved",
    ]
    assert table.rows == [
        ["a", "3", "1.23", "0.057", "yes"],
        ["b", "0", "-", "1.000", "no"],
    ]
