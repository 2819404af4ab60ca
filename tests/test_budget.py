"""What reading costs: the budget in docs/architecture.md, density, and the house rule."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "evercal"
BESIDE = ("benchmarks", "rooms", "tests", "training")
"""Folders beside the source, each with a budget as a whole."""
NODES_A_LINE = 6.0
"""Syntax nodes on a line of code of a folder, at most."""
FORMULAS = {"geometry": 8.0}
"""The same for folders of formulas."""
PACKED = 5
"""Packed assignments (`a, b = x, y`) in 1,000 lines of code of a folder, at most."""
CONDITIONAL = 15
"""Conditional expressions in 1,000 lines of code of a folder, at most."""
COMPREHENSIONS = 30
"""Comprehensions and generator expressions in 1,000 lines of code of a folder, at most."""
FILE_LINES = 400
"""Lines of a file, at most."""
FUNCTION_LINES = 60
"""Lines of a function, at most."""
PARAMETERS = 6
"""Parameters of a function, at most, without self and cls."""
PUBLIC = {"map.py": ("align",), "learning/learned_scenes.py": ("learn", "learn_many")}
"""Methods that users call with keywords, which may have more parameters."""
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
_COMPREHENSION = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
_FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Weight:
    """What reading some code costs."""

    lines: int = 0
    """Lines that hold code: no blank lines, comments or docstrings."""
    nodes: int = 0
    """Syntax nodes, without docstrings and the contexts of names."""
    packed: int = 0
    """Packed assignments."""
    conditional: int = 0
    """Conditional expressions."""
    comprehensions: int = 0
    """Comprehensions and generator expressions."""

    def __add__(self, other: Weight) -> Weight:
        return Weight(
            self.lines + other.lines,
            self.nodes + other.nodes,
            self.packed + other.packed,
            self.conditional + other.conditional,
            self.comprehensions + other.comprehensions,
        )


def weight(source: str) -> Weight:
    """What reading a file costs."""
    tree = ast.parse(source)
    docstrings = list(_docstrings(tree))
    inside = {id(node) for text in docstrings for node in ast.walk(text)}
    nodes = [node for node in ast.walk(tree) if not isinstance(node, ast.expr_context)]
    count = Counter(type(node) for node in nodes)
    return Weight(
        len(_code_lines(source, docstrings)),
        sum(id(node) not in inside for node in nodes),
        sum(map(_is_packed, nodes)),
        count[ast.IfExp],
        sum(count[kind] for kind in _COMPREHENSION),
    )


def _docstrings(tree: ast.AST) -> Iterator[ast.Expr]:
    for node in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            block = getattr(node, field, None)
            if isinstance(block, list):
                yield from filter(_is_docstring, block)


def _is_docstring(node: ast.AST) -> bool:
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
        return False
    return isinstance(node.value.value, str)


def _is_packed(node: ast.AST) -> bool:
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    return any(isinstance(target, ast.Tuple) for target in node.targets)


def _code_lines(source: str, docstrings: list[ast.Expr]) -> set[int]:
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for text in docstrings:
        lines.difference_update(range(text.lineno, (text.end_lineno or 0) + 1))
    return lines


@cache
def weights() -> dict[str, Weight]:
    """What each folder of the source costs, and each folder beside it."""
    of = dict[str, Weight]()
    files = [(path, path.relative_to(SOURCE).parts) for path in SOURCE.rglob("*.py")]
    for path, parts in files:
        folder = parts[0] if len(parts) > 1 else "."
        cost = weight(path.read_text("utf-8"))
        for name in (folder, "src"):
            of[name] = of.get(name, Weight()) + cost
    for name in BESIDE:
        for path in (ROOT / name).rglob("*.py"):
            of[name] = of.get(name, Weight()) + weight(path.read_text("utf-8"))
    return of


def budget() -> dict[str, int]:
    """Syntax nodes that each folder may hold, by the page."""
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    table = page.partition("## Budget")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `([\w./]+)` \| ([\d,]+) \|$", table, re.M)
    return {name: int(most.replace(",", "")) for name, most in rows}


def broken_rules(source: str, name: str = "") -> list[str]:
    """Files, functions and constants that break the house rule."""
    tree = ast.parse(source)
    broken = []
    if source.count("\n") > FILE_LINES:
        broken.append(f"{name}: {source.count(chr(10))} lines")
    for node in ast.walk(tree):
        if isinstance(node, _FUNCTION):
            broken += _broken_function(node, name)
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement, following in zip(node.body, node.body[1:], strict=False):
                if _is_packed(statement) and _is_docstring(following):
                    what = "one docstring for several names"
                    broken.append(f"{name}:{statement.lineno} {what}")
    return broken


def _broken_function(
    node: ast.FunctionDef | ast.AsyncFunctionDef, name: str
) -> list[str]:
    where = f"{name}:{node.lineno} {node.name}"
    lines = (node.end_lineno or 0) - node.lineno + 1
    arguments = node.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    count = len([one for one in named if one.arg not in ("self", "cls")])
    broken = []
    if lines > FUNCTION_LINES:
        broken.append(f"{where}: {lines} lines")
    if count > PARAMETERS and node.name not in PUBLIC.get(name, ()):
        broken.append(f"{where}: {count} parameters")
    return broken


def test_what_reading_costs_is_counted() -> None:
    assert weight('"""A module."""\n\n# Why.\nx = [\n    1,\n]\n') == Weight(3, 5)
    text = 'def f():\n    """Do.\n\n    More.\n    """\n    return """a\nb"""\n'
    assert weight(text).lines == 3
    dense = "a, b = 1, 2\nc = a if b else [d for d in a]\n"
    assert weight(dense) == Weight(2, 18, 1, 1, 1)
    assert weight("(a, b), c = f(), (1, 2)").packed == 1
    assert weight("a, b = f()").packed == 0


def test_no_folder_exceeds_its_budget() -> None:
    """A change that needs more takes it away elsewhere."""
    allowed = budget()
    assert {*allowed} == {*weights()}
    over = [
        f"{name}: {cost.nodes} syntax nodes, {allowed[name]} in docs/architecture.md"
        for name, cost in sorted(weights().items())
        if cost.nodes > allowed[name]
    ]
    assert not over, "\n".join(over)


@pytest.mark.parametrize("name", sorted({*budget()} - {*BESIDE}))
def test_no_folder_is_dense(name: str) -> None:
    cost = weights()[name]
    thousands = cost.lines / 1000
    assert cost.nodes <= FORMULAS.get(name, NODES_A_LINE) * cost.lines
    assert cost.packed <= PACKED * thousands
    assert cost.conditional <= CONDITIONAL * thousands
    assert cost.comprehensions <= COMPREHENSIONS * thousands


def test_the_house_rule_is_kept() -> None:
    broken = []
    for path in sorted(SOURCE.rglob("*.py")):
        name = path.relative_to(SOURCE).as_posix()
        broken += broken_rules(path.read_text("utf-8"), name)
    for folder in BESIDE:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            broken += broken_rules(path.read_text("utf-8"), name)
    assert not broken, "\n".join(broken)


def test_planted_breaks_of_the_house_rule_are_reported() -> None:
    assert broken_rules("x = 1\n" * 401) == [": 401 lines"]
    long = "def f():\n" + "    x = 1\n" * 60
    assert broken_rules(long) == [":1 f: 61 lines"]
    seven = "class A:\n    def f(self, a, b, c, *, d, e, g, h): ...\n"
    assert broken_rules(seven) == [":2 f: 7 parameters"]
    packed = 'A, B = 1, 2\n"""Two numbers."""\n'
    assert broken_rules(packed) == [":1 one docstring for several names"]
    assert broken_rules('A = 1\n"""One."""\nB = 2\n"""Another."""\n') == []
