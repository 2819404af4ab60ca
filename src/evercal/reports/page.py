"""A page in one file: text, tables and pictures, readable offline and for ever."""

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with what it shows."""

    data: bytes
    """A PNG or JPEG file."""
    caption: str = ""
    """Below the picture, and read aloud in its place."""


@dataclass(frozen=True, eq=False)
class Table:
    """Cells in rows; numbers stand to the right, by what the cell is or reads as."""

    header: Sequence[str]
    """One title per column."""
    rows: Sequence[Sequence[str | int | float]]
    """As many cells each; numbers are written as `str` writes them, so round them before."""
    caption: str = ""
    """Above the table."""


@dataclass(frozen=True, eq=False)
class Section:
    """A heading and what follows, in order; a string is a paragraph."""

    heading: str
    """Empty for none."""
    blocks: Sequence[str | Picture | Table]
    """Paragraphs, pictures and tables."""


_STYLE = """
:root { color-scheme: light dark; --text: #1b1f24; --quiet: #59636e; --line: #d1d9e0;
  --back: #fff; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6edf3; --quiet: #9198a1; --line: #3d444d; --back: #0d1117; } }
body { margin: 2.5rem auto; padding: 0 1.2rem; max-width: 62rem; background: var(--back);
  color: var(--text); font: 16px/1.55 system-ui, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 1.5rem; } h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; }
p { max-width: 44rem; white-space: pre-line; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; }
caption, figcaption { color: var(--quiet); font-size: .9rem; text-align: left; }
caption { padding-bottom: .4rem; }
th, td { padding: .3rem .8rem; border-bottom: 1px solid var(--line); text-align: left; }
th { font-weight: 600; vertical-align: bottom; } .n { text-align: right; }
td.n { white-space: nowrap; }
figure { margin: 1.2rem 0; }
img { max-width: 100%; height: auto; border-radius: 4px; background: #fff; }
""".strip()


def html_page(title: str, sections: Sequence[Section]) -> str:
    """One HTML document that refers to nothing outside itself.

    Everything given is text, never markup: `<`, `&` and quotes show as they are.

    Args:
        title: At the top and in the browser's tab.
        sections: In order.

    Raises:
        ValueError: A picture that is neither PNG nor JPEG, or a row that does not fit its header.
    """
    body = "\n".join(_section(section) for section in sections)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        # The page can fetch and run nothing, whatever a scene's name may contain.
        '<meta http-equiv="Content-Security-Policy"'
        " content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
        f"<title>{html.escape(title)}</title>\n<style>\n{_STYLE}\n</style>\n</head>\n"
        f"<body>\n<h1>{html.escape(title)}</h1>\n{body}\n</body>\n</html>\n"
    )


def _section(section: Section) -> str:
    parts = [f"<h2>{html.escape(section.heading)}</h2>"] if section.heading else []
    for block in section.blocks:
        if isinstance(block, Picture):
            parts.append(_picture(block))
        elif isinstance(block, Table):
            parts.append(_table(block))
        else:
            parts.append(f"<p>{html.escape(block)}</p>")
    return "<section>\n" + "\n".join(parts) + "\n</section>"


def _picture(picture: Picture) -> str:
    if picture.data.startswith(b"\x89PNG\r\n\x1a\n"):
        kind = "png"
    elif picture.data.startswith(b"\xff\xd8\xff"):
        kind = "jpeg"
    else:
        raise ValueError(f"a picture is a PNG or JPEG file, got {picture.data[:8]!r}")
    caption = html.escape(picture.caption)
    source = f"data:image/{kind};base64,{base64.b64encode(picture.data).decode()}"
    below = f"<figcaption>{caption}</figcaption>" if caption else ""
    return f'<figure><img src="{source}" alt="{caption}">{below}</figure>'


def _table(table: Table) -> str:
    for row in table.rows:
        if len(row) != len(table.header):
            raise ValueError(f"a row has {len(table.header)} cells, as the header; got {row}")
    # A column's title stands over its cells: to the right if they are numbers.
    numeric = [
        bool(table.rows) and all(_is_number(row[i]) for row in table.rows)
        for i in range(len(table.header))
    ]
    caption = f"<caption>{html.escape(table.caption)}</caption>" if table.caption else ""
    head = _row("th", table.header, numeric)
    body = "\n".join(_row("td", row, [_is_number(cell) for cell in row]) for row in table.rows)
    return (
        f'<div class="wide"><table>{caption}\n<thead>{head}</thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def _row(tag: str, cells: Sequence[str | int | float], numeric: Sequence[bool]) -> str:
    classes = [' class="n"' if flag else "" for flag in numeric]
    inner = "".join(
        f"<{tag}{mark}>{html.escape(str(cell))}</{tag}>"
        for cell, mark in zip(cells, classes, strict=True)
    )
    return f"<tr>{inner}</tr>"


def _is_number(cell: str | int | float) -> bool:
    """Whether a cell reads as a number; a blank and a dash stand for a missing one."""
    if not isinstance(cell, str) or cell.strip() in ("", "-"):
        return True
    try:
        float(cell.strip().removesuffix("%").removesuffix(" mm").removesuffix(" cm"))
    except ValueError:
        return False
    return True
