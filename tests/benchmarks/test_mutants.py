"""Mutations are small, and a seed draws the same ones."""

from __future__ import annotations

from pathlib import Path

import evercal
from benchmarks.mutation import drawn

SOURCE = '''"""At most 2 of 3."""

LIMIT = 2.5


def area(a: float, *, b: int = 0) -> float:
    """Text."""
    if not a < min(b, LIMIT):
        raise ValueError(f"{a - b} < 0")
    a += 1
    return float(a, b)
'''


def test_operators_numbers_conditions_statements_and_arguments_change() -> None:
    found = drawn(SOURCE, 100, "all")
    assert {mutation.change for mutation in found} == {
        "LIMIT = [2.5 -> (2.5 * 2 or 1)]",
        "def area(a: float, *, b: int = [0 -> (0 + 1)]) -> float:",
        "[if -> if not] not a < min(b, LIMIT):",
        "if [not -> ] a < min(b, LIMIT):",
        "if not a [< -> <=] min(b, LIMIT):",
        "if not a < [min -> max](b, LIMIT):",
        "if not a < min([b, LIMIT -> LIMIT, b]):",
        '[raise ValueError(f"{a - b} < 0") -> pass]',
        "a [+= -> -=] 1",
        "a += [1 -> (1 + 1)]",
        "[a += 1 -> pass]",
        "[return -> return None;] float(a, b)",
        "return float([a, b -> b, a])",
    }
    assert {mutation.function for mutation in found} == {"", "area"}


def test_each_is_python_that_differs_in_its_line() -> None:
    source = (Path(evercal.__file__).parent / "geometry" / "se3.py").read_text()
    found = drawn(source, 50, "1")
    assert len(found) == len({mutation.source for mutation in found}) == 50
    for mutation in found:
        lines = mutation.source.splitlines()
        assert lines[: mutation.line - 1] == source.splitlines()[: mutation.line - 1]
        assert lines[mutation.line - 1] != source.splitlines()[mutation.line - 1]


def test_a_seed_draws_the_same_and_another_one_does_not() -> None:
    first, again, other = (drawn(SOURCE, 5, seed) for seed in ("1", "1", "2"))
    assert first == again != other
