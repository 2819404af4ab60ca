"""How objects look in a notebook: a small table."""

from collections.abc import Mapping
from html import escape


def html_table(title: str, rows: Mapping[str, object]) -> str:
    """A table of names and values below a title; all text is escaped."""
    lines = [f"<table><caption>{escape(title)}</caption>"]
    for name, value in rows.items():
        cells = f"<th>{escape(name)}</th><td>{escape(str(value))}</td>"
        lines.append(f"<tr>{cells}</tr>")
    return "".join([*lines, "</table>"])
