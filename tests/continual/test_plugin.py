"""Strategies from a user's file."""

from pathlib import Path

import numpy as np
import pytest

from evercal.continual.plugin import load_plugin
from evercal.continual.strategies import STRATEGIES
from evercal.errors import InputError

EXAMPLE = Path(__file__).parents[2] / "examples" / "my_strategy.py"


@pytest.fixture(autouse=True)
def _restored() -> object:
    before = dict(STRATEGIES)
    yield
    STRATEGIES.clear()
    STRATEGIES.update(before)


def test_the_example_is_short_and_can_be_loaded_twice() -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 40
    assert load_plugin(EXAMPLE) == ("spread",)
    select = STRATEGIES["spread"].select
    assert select is not None

    class Line:
        positions_m = np.linspace(0, 1, 11)[:, None] * [1.0, 0, 0]
        quaternions_wxyz = np.tile([1.0, 0, 0, 0], (11, 1))

    assert select(Line(), 3).tolist() == [0, 5, 10]  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="'spread' is evercal's own"):
        load_plugin(EXAMPLE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("STRATEGIES = 3", "defines no STRATEGIES"),
        ("x = 1", "defines no STRATEGIES"),
        ("STRATEGIES = {}", "defines no STRATEGIES"),
        ("STRATEGIES = {'a': 1}", "defines no STRATEGIES"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("def :", "SyntaxError"),
    ],
)
def test_files_that_are_no_plugins(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.py"
    path.write_text(text)
    before = dict(STRATEGIES)
    with pytest.raises(InputError, match=message):
        load_plugin(path)
    assert before == STRATEGIES


def test_names_of_ours_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "from evercal.continual.strategies import Strategy\n"
        "STRATEGIES = {'finetune': Strategy(source='mine')}"
    )
    with pytest.raises(InputError, match="'finetune' is evercal's own"):
        load_plugin(path)
    with pytest.raises(InputError, match="no such file"):
        load_plugin(tmp_path / "none.py")
    (tmp_path / "mine.txt").write_text("")
    with pytest.raises(InputError, match=r"ends in \.py"):
        load_plugin(tmp_path / "mine.txt")
