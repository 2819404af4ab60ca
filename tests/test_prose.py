"""Sentences that users and readers meet are short: docs, docstrings and help."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONGEST = 40
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
MODULES = sorted((ROOT / "src").rglob("*.py"))


def paragraphs(text: str) -> Iterator[str]:
    """Paragraphs and list items of a Markdown page, without code, tables and headings."""
    lines: list[str] = []
    in_code = False
    for line in [*text.splitlines(), ""]:
        in_code ^= line.startswith("```")
        item = line.startswith(("- ", "* "))
        skipped = in_code or line.startswith(("    ", "|", "#", "<!--", "```", "!["))
        if (skipped or item or not line.strip()) and lines:
            yield " ".join(lines)
            lines = []
        if not skipped and line.strip():
            lines.append(line.lstrip("-* ").strip())


def docstrings(text: str) -> Iterator[str]:
    """Paragraphs of the docstrings of a module, attribute docstrings included."""
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
            continue
        if isinstance(node.value.value, str):
            yield from re.split(r"\n\s*\n", node.value.value)


def long_sentences(texts: Iterator[str]) -> list[str]:
    """Sentences of more words than allowed; code, links and lists of fields count little."""
    found = []
    for text in texts:
        plain = re.sub(r"`[^`]*`", "x", " ".join(text.split()))
        plain = re.sub(r"\]\([^)]*\)", "]", plain)
        for sentence in re.split(r"(?<=[.!?;:])\s+", plain):
            if len(sentence.split()) > LONGEST:
                found.append(sentence)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_sentences_of_pages_are_short(page: Path) -> None:
    assert long_sentences(paragraphs(page.read_text(encoding="utf-8"))) == []


def test_sentences_of_docstrings_and_help_are_short() -> None:
    long = {
        str(path.relative_to(ROOT)): sentences
        for path in MODULES
        if (sentences := long_sentences(docstrings(path.read_text(encoding="utf-8"))))
    }
    assert long == {}


def test_long_sentences_are_noticed() -> None:
    words = " ".join(["word"] * 41)
    assert long_sentences(iter([f"Short. {words}. Short."])) == [f"{words}."]
    assert long_sentences(paragraphs(f"# Title\n\n- {words}\n\n```\n{words}\n```\n")) == [words]
    assert long_sentences(docstrings(f'def f():\n    """{words}"""\n')) == [words]
