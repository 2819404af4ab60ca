"""Strategies from a user's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evercal.continual.strategies import STRATEGIES, load_plugin
from evercal.errors import InputError

EXAMPLE = Path(__file__).parents[2] / "examples" / "my_strategy.py"


@pytest.fixture(autouse=True)
def _restored() -> object:
    before = dict(STRATEGIES)
    yield
    STRATEGIES.clear()
    STRATEGIES.update(before)


def test_example_is_short_and_can_be_loaded_twice() -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 40
    assert load_plugin(EXAMPLE) == ("spread",)
    method = STRATEGIES["spread"].method
    assert method is not None

    class Line:
        positions_m = np.linspace(0, 1, 11)[:, None] * [1.0, 0, 0]
        quaternions_wxyz = np.tile([1.0, 0, 0, 0], (11, 1))

    selected = method.select(Line(), 3)  # pyright: ignore[reportArgumentType]
    assert selected is not None
    assert selected.tolist() == [0, 5, 10]
    # Its hyper-parameters are recorded.
    records = STRATEGIES["spread"].description()["method"]
    assert isinstance(records, dict)
    assert (records["kind"], records["penalty"]) == (
        "Spread",
        {"kind": "OldOutput", "px_per_m": 25.0},
    )
    with pytest.raises(InputError, match="'spread' exists"):
        load_plugin(EXAMPLE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "defines no STRATEGIES"),
        ("STRATEGIES = {}", "defines no STRATEGIES"),
        ("STRATEGIES = {'a': 1}", "defines no STRATEGIES"),
        (
            "from evercal.continual.strategies import Strategy\n"
            "STRATEGIES = {'mine': Strategy('other')}",
            "defines no STRATEGIES",
        ),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("def :", "SyntaxError"),
    ],
)
def test_invalid_plugins_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text)
    before = dict(STRATEGIES)
    with pytest.raises(InputError, match=message):
        load_plugin(path)
    assert before == STRATEGIES


def test_existing_names_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "from evercal.continual.strategies import Strategy\n"
        "STRATEGIES = {'finetune': Strategy('finetune', source='mine')}"
    )
    with pytest.raises(InputError, match="'finetune' exists"):
        load_plugin(path)
    (tmp_path / "mine.txt").write_text("")
    for name in ("none.py", "mine.txt"):
        with pytest.raises(InputError, match=r"ends in \.py"):
            load_plugin(tmp_path / name)
