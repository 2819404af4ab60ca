"""Small changes of Python code: operators, numbers, conditions, statements, order of arguments."""

import ast
import io
import random
import re
import tokenize
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, pairwise

_OTHER = {
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "is": "is not",
    "in": "not in",
    "not": "",
    "and": "or",
    "or": "and",
    "if": "if not",
    "elif": "elif not",
    "while": "while not",
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "//": "/",
    "**": "*",
    "%": "*",
    "+=": "-=",
    "-=": "+=",
    "*=": "/=",
    "/=": "*=",
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "True": "False",
    "False": "True",
    "return": "return None;",
}
"""Words of Python, and what stands in their place."""
_DROPPED = (ast.AugAssign, ast.Raise, ast.Continue, ast.Break)
"""Statements without which a function still runs, as without some calls."""
_Edit = tuple[int, int, str]
"""Start and end of the old text, and the new one."""


@dataclass(frozen=True)
class Mutation:
    """One change of a file."""

    line: int
    """Where it begins."""
    function: str
    """The last function that begins before it."""
    change: str
    """The line, with old and new code."""
    source: str
    """The whole file with the change."""


def drawn(source: str, count: int, seed: str) -> list[Mutation]:
    """Different mutations of a file, by a seed; all of them if there are fewer."""
    lines = source.splitlines(keepends=True)
    starts = [0, *accumulate(map(len, lines))]
    edits = sorted([*_word_edits(source, starts), *_node_edits(source, starts)])
    random.Random(seed).shuffle(edits)
    found = list[Mutation]()
    for edit in edits:
        with suppress(SyntaxError):
            if len(found) < count:
                found.append(_mutation(source, *edit))
    return found


def _word_edits(source: str, starts: list[int]) -> Iterator[_Edit]:
    """Other operators, keywords and numbers."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        text = token.string
        new = _OTHER.get(text)
        if token.type == tokenize.NUMBER:
            new = f"({text} + 1)" if text.isdigit() else f"({text} * 2 or 1)"
        start = starts[token.start[0] - 1] + token.start[1]
        end = start + len(text)
        starred = text == "*" and source[end] != " "
        if new is not None and not starred and not token.line.lstrip().startswith("@"):
            yield start, end, new


def _node_edits(source: str, starts: list[int]) -> Iterator[_Edit]:
    """Two arguments of a call swapped; a statement left out."""

    def span(node: ast.expr | ast.stmt) -> tuple[int, int]:
        end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        return starts[node.lineno - 1] + node.col_offset, end

    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            for one, other in pairwise(node.args):
                start, middle = span(one)
                again, end = span(other)
                between = source[middle:again]
                # Python before 3.12 does not know where the parts of an f-string stand.
                if between.strip() == ",":
                    swapped = source[again:end] + between + source[start:middle]
                    yield start, end, swapped
        if isinstance(node, ast.Expr) and not isinstance(node.value, ast.Call):
            continue
        if isinstance(node, (*_DROPPED, ast.Expr)):
            yield (*span(node), "pass")


def _mutation(source: str, start: int, end: int, new: str) -> Mutation:
    text = source[:start] + new + source[end:]
    compile(text, "mutant", "exec")
    before = source[:start]
    after = source[end:].partition("\n")[0]
    change = f"{before.rpartition(chr(10))[2]}[{source[start:end]} -> {new}]{after}"
    function = re.findall(r"def (\w+)", before)[-1:]
    line = before.count("\n") + 1
    return Mutation(line, "".join(function), " ".join(change.split()), text)
