"""The budget of code lines in docs/architecture.md: no folder holds more than it states."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(source: str) -> int:
    """Lines that hold code: no blank lines, comments or docstrings."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    lines = {
        line
        for token in tokens
        if token.type not in _NO_CODE
        for line in range(token.start[0], token.end[0] + 1)
    }
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def test_code_lines_are_counted() -> None:
    assert code_lines('"""A module."""\n\n# Why.\nx = [\n    1,\n]\n') == 3
    assert (
        code_lines(
            'def f():\n    """Do.\n\n    More.\n    """\n    return """a\nb"""\n'
        )
        == 3
    )


def test_no_folder_exceeds_its_budget() -> None:
    """Who needs more raises the number in the same change and says why in its message."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = page.partition("## Budget")[2].partition("\n## ")[0]
    budget = {
        name: int(most.replace(",", ""))
        for name, most in re.findall(r"^\| `([\w./]+)` \| ([\d,]+) \|$", table, re.M)
    }
    source = ROOT / "src" / "evercal"
    count = Counter[str]()
    for path in source.rglob("*.py"):
        folder = path.relative_to(source).parts[0]
        lines = code_lines(path.read_text(encoding="utf-8"))
        count[folder if folder != path.name else "."] += lines
        count["src"] += lines
    for folder in ("tests", "benchmarks", "rooms", "training"):
        for path in (ROOT / folder).rglob("*.py"):
            count[folder] += code_lines(path.read_text(encoding="utf-8"))
    assert budget.keys() == count.keys()
    over = {
        name: (lines, budget[name])
        for name, lines in count.items()
        if lines > budget[name]
    }
    assert not over, f"more code lines than docs/architecture.md allows: {over}"
