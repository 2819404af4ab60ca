"""Every message that docs/troubleshooting.md quotes is one that the program prints."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (`.*?`) \| .*? \| .*? \|$", PAGE, re.M)
QUOTED = [row.strip("`") for row in ROWS]
GAP = "…"
"""Stands for a value, on the page and in the texts of the source."""


def texts(source: str) -> set[str]:
    """Strings of a module; a gap stands for each value of an f-string."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            parts = [str(p.value) if isinstance(p, ast.Constant) else GAP for p in node.values]
            found.add("".join(parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found


def is_quote(message: str, text: str) -> bool:
    """Whether a message is a part of a text; a gap may stand for more than one value."""
    parts = [re.escape(part) for part in message.split(GAP)]
    return re.search(".*".join(parts), text) is not None


SOURCE = {
    text
    for path in sorted((ROOT / "src").rglob("*.py"))
    for text in texts(path.read_text(encoding="utf-8"))
}


@pytest.mark.parametrize("message", QUOTED)
def test_quoted_message_is_in_the_source(message: str) -> None:
    assert len(re.sub(r"\W", "", message)) >= 8, "too short to identify a message"
    assert any(is_quote(message, text) for text in SOURCE)


def test_page_quotes_messages_of_every_kind() -> None:
    assert len(QUOTED) > 40
    assert len(QUOTED) == len(set(QUOTED))


def test_other_messages_are_noticed() -> None:
    text = "scene …: the map has only …; give one"
    assert text in texts('x = f"scene {name!r}: the map has only" f" {names}; give one"\n')
    assert is_quote("scene …: the map has only …; give one", text)
    assert is_quote("the map has only", text)
    assert not is_quote("scene …: the map lacks …", text)
