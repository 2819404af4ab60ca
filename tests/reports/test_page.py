"""The page is well-formed, self-contained and shows text as text."""

import base64
from html.parser import HTMLParser

import numpy as np
import pytest

from evercal.reports import Picture, Section, Table, encode_image, html_page

PNG = encode_image(np.zeros((2, 3, 3), np.uint8))
JPG = encode_image(np.zeros((2, 3, 3), np.uint8), "jpg")
NASTY = "<script>alert(\"1\")</script> & 'x'"


class Reader(HTMLParser):
    """Collects tags and text, and fails on a tag closed out of turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[tuple[str, str]] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.text.append((self.open[-1], data))

    def said(self, tag: str) -> list[str]:
        return [text for where, text in self.text if where == tag]


def test_everything_given_is_text_and_in_order() -> None:
    page = Reader(
        html_page(
            NASTY,
            [
                Section(NASTY, [NASTY, Picture(PNG, NASTY), "then"]),
                Section("", [Table([NASTY], [[NASTY]], NASTY)]),
            ],
        )
    )
    for tag in ("title", "h1", "h2", "figcaption", "th", "td", "caption"):
        assert page.said(tag) == [NASTY], tag
    assert page.said("p") == [NASTY, "then"]
    names = [tag for tag, _ in page.tags]
    assert "script" not in names
    assert names.count("h2") == 1  # an empty heading is none
    (image,) = (attributes for tag, attributes in page.tags if tag == "img")
    assert image["alt"] == NASTY
    assert names.index("img") > names.index("p")


@pytest.mark.parametrize(("data", "kind"), [(PNG, "png"), (JPG, "jpeg")])
def test_pictures_travel_inside_the_page(data: bytes, kind: str) -> None:
    page = Reader(html_page("t", [Section("s", [Picture(data)])]))
    (image,) = (attributes for tag, attributes in page.tags if tag == "img")
    head, _, body = (image["src"] or "").partition(",")
    assert head == f"data:image/{kind};base64"
    assert base64.b64decode(body) == data


def test_nothing_is_fetched_from_elsewhere() -> None:
    text = html_page("t", [Section("s", ["p", Picture(PNG), Table(["a"], [[1]])])])
    assert "http://" not in text
    assert "https://" not in text
    assert "url(" not in text
    assert "default-src 'none'" in text
    assert "prefers-color-scheme: dark" in text


def test_numbers_stand_to_the_right_and_titles_over_them() -> None:
    rows = [["chess", 97.5, "12 %", "-"], ["stairs", "inf", 3, "7.1"]]
    page = Reader(html_page("t", [Section("s", [Table(["scene", "acc", "share", "cm"], rows)])]))
    right = [(tag, "class" in attrs) for tag, attrs in page.tags if tag in ("th", "td")]
    assert right == [("th", i > 0) for i in range(4)] + [("td", i > 0) for i in range(4)] * 2
    assert page.said("td") == ["chess", "97.5", "12 %", "-", "stairs", "inf", "3", "7.1"]


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match="PNG or JPEG"):
        html_page("t", [Section("s", [Picture(b"GIF89a")])])
    with pytest.raises(ValueError, match="2 cells"):
        html_page("t", [Section("s", [Table(["a", "b"], [["x"]])])])
