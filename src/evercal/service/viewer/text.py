"""HTML of the panel; names of files and scenes are escaped."""

import base64
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from evercal.recordings.images import encode_jpeg
from evercal.reports.scene.map_parts import resized
from evercal.service.viewer.answers import AnswerView, shares_of_light

Rows = Sequence[tuple[str, str]]
PICTURE_PX = 640
"""Width of a picture; the panel may show it smaller."""
OWN = "evercal"
"""Class of all HTML that is not of viser."""
FAINT = 0.8
"""Opacity of secondary text; less is hard to read on a dark ground."""
_CELL = "padding:1px 8px 1px 0;vertical-align:top"


def chip(text: str, colour: tuple[int, int, int]) -> str:
    """A word on a coloured ground."""
    red, green, blue = colour
    style = (
        f"background:rgb({red},{green},{blue});color:{_legible_on(colour)};border-radius:4px;"
        "padding:2px 8px;font-weight:600"
    )
    return f'<span style="{style}">{escape(text)}</span>'


def _legible_on(colour: tuple[int, int, int]) -> str:
    """Black or white, whichever has more contrast (relative luminance of WCAG 2.2)."""
    luminance = float(shares_of_light(colour) @ [0.2126, 0.7152, 0.0722])
    return "black" if (luminance + 0.05) ** 2 > 1.05 * 0.05 else "white"


def table(rows: Rows) -> str:
    """Names and values, one pair a line."""
    lines = [
        f'<tr><td style="{_CELL};opacity:{FAINT};width:38%">{escape(name)}</td>'
        f'<td style="{_CELL};overflow-wrap:anywhere">{escape(value)}</td></tr>'
        for name, value in rows
    ]
    return f'<table style="width:100%;font-size:0.82em;line-height:1.35">{"".join(lines)}</table>'


def answer_html(view: AnswerView, more: Rows = ()) -> str:
    """State and numbers of an answer; `more` are further rows."""
    return block(chip(view.state, view.colour), table([*view.rows, *more]))


def rows_html(rows: Rows) -> str:
    """A table alone; nothing without rows."""
    return block(table(rows)) if rows else ""


def note_html(text: str) -> str:
    """A sentence."""
    return block(f'<span style="font-size:0.82em;opacity:{FAINT}">{escape(text)}</span>')


def picture_html(
    image: NDArray[np.uint8], words: str, width: int = PICTURE_PX, style: str = ""
) -> str:
    """A picture with a text alternative.

    Images of viser have no words, and ask the browser for addresses that are gone when they change.
    """
    style = f"display:block;margin:0 auto;max-width:100%;border-radius:4px;{style}"
    return block(f'<img src="{jpeg_url(image, width)}" alt="{escape(words)}" style="{style}">')


def jpeg_url(image: NDArray[np.uint8], width: int) -> str:
    """A JPEG as the address of an HTML image."""
    data = encode_jpeg(resized(image, width), quality=85)
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def block(*parts: str) -> str:
    """Parts one below the other."""
    return f'<div class="{OWN}" style="padding:2px 12px 6px">{"".join(parts)}</div>'
