"""The list of strategies, their descriptions, and strategies from a user's file."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from evercal.continual.methods.method import FineTuning, Method, described
from evercal.continual.methods.penalties import Distillation
from evercal.continual.methods.replay import Replay
from evercal.continual.selection.selectors import SELECTORS
from evercal.continual.strategies import (
    STRATEGIES,
    Strategy,
    load_plugin,
    strategy_named,
)
from evercal.errors import InputError


@pytest.mark.parametrize(("name", "strategy"), STRATEGIES.items())
def test_strategies_are_consistent(name: str, strategy: Strategy) -> None:
    assert strategy.name == name
    assert name.isidentifier()
    if isinstance(strategy.method, Replay):
        assert strategy.method.selector in SELECTORS
        assert strategy.method.replays
        assert strategy.method.weight > 0
    if strategy.jointly:
        assert strategy.method == FineTuning()


@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=lambda s: s.name)
def test_description_contains_all_hyper_parameters(strategy: Strategy) -> None:
    records = strategy.description()
    assert json.loads(json.dumps(records)) == records
    assert records["map"] == (strategy.method is None)
    assert records.get("jointly", False) == strategy.jointly
    if strategy.method is None:
        assert records["method"] is None
        return
    method = records["method"]
    assert isinstance(method, dict)
    assert method["kind"] == type(strategy.method).__name__
    assert method.keys() - {"kind"} == {field.name for field in fields(strategy.method)}


@dataclass(frozen=True)
class FromFile(Method):
    """A method of a plugin with a file."""

    file: Path = Path("weights.npz")


def test_a_method_with_a_file_is_described() -> None:
    assert described(FromFile()) == {"kind": "FromFile", "file": "weights.npz"}


def test_sars_spdd_has_the_settings_of_the_paper() -> None:
    """SARS with the fixed radius, SPDD with weights 1, tau 2 and 50 active centres."""
    method = strategy_named("sars_spdd", paper_head=True).method
    assert isinstance(method, Replay)
    assert method == Replay("sars", Distillation(), weight=1.0)
    assert isinstance(method.penalty, Distillation)
    options = method.penalty.options
    assert (options.prior_weight, options.metric_weight, options.output_weight) == (
        1,
        1,
        1,
    )
    assert (options.temperature, options.active_centres) == (2.0, 50)


def test_unknown_strategy_is_refused() -> None:
    assert strategy_named("er") is STRATEGIES["er"]
    for name in ("nonsense", "sars+spdd", "er@0.3", ""):
        with pytest.raises(
            InputError, match=r"unknown; choose one of evercal, .* joint"
        ):
            strategy_named(name)


EXAMPLE = Path(__file__).parents[2] / "examples" / "my_strategy.py"


@pytest.fixture
def _restored() -> Iterator[None]:
    before = dict(STRATEGIES)
    yield
    STRATEGIES.clear()
    STRATEGIES.update(before)


@pytest.mark.usefixtures("_restored")
def test_example_can_be_loaded_once() -> None:
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
    records = described(method)  # with its hyper-parameters
    penalty = {"kind": "OldOutput", "px_per_m": 25.0}
    assert (records["kind"], records["penalty"]) == ("Spread", penalty)
    with pytest.raises(InputError, match="'spread' exists"):
        load_plugin(EXAMPLE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "defines no STRATEGIES"),
        ("STRATEGIES = {}", "defines no STRATEGIES"),
        ("STRATEGIES = {'mine': Strategy('other')}", "defines no STRATEGIES"),
        (
            "STRATEGIES = {'finetune': Strategy('finetune', jointly=True)}",
            "'finetune' exists",
        ),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("def :", "SyntaxError"),
    ],
)
def test_invalid_plugins_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.py"
    before = dict(STRATEGIES)
    path.write_text(f"from evercal.continual.strategies import Strategy\n{text}")
    with pytest.raises(InputError, match=message):
        load_plugin(path)
    assert before == STRATEGIES
    path.with_suffix(".txt").write_text("")
    for name in ("none.py", "mine.txt"):
        with pytest.raises(InputError, match=r"ends in \.py"):
            load_plugin(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "weighted"),
    [
        ("er", lambda method: method.weight),
        ("mir", lambda method: method.weight),
        ("sars_spdd", lambda method: method.weight),
        ("gec", lambda method: method.alpha),
        ("ewc", lambda method: method.strength),
    ],
)
def test_a_method_has_one_weight(name: str, weighted: Callable[[Any], float]) -> None:
    strategy = strategy_named(name)
    other = strategy.weighted(0.125)
    assert weighted(other.method) == 0.125 != weighted(strategy.method)
    assert strategy.weighted(weighted(strategy.method)) == strategy


def test_a_weight_is_refused_by_name() -> None:
    for name in ("evercal", "finetune", "isolation", "joint"):
        with pytest.raises(InputError, match=f"`weight` 2.0: strategy '{name}'"):
            strategy_named(name).weighted(2.0)
    for weight in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="give a number >= 0"):
            strategy_named("er").weighted(weight)


def test_weights_are_those_that_tuning_chose() -> None:
    """The best trials of results/tuned-converged.csv and tuned-paper-head.csv."""
    results = Path(__file__).parents[2] / "results"
    for name, paper_head in (("converged", False), ("paper-head", True)):
        trials = pd.read_csv(results / f"tuned-{name}.csv")
        for strategy, rows in trials.groupby("method"):
            best = rows.loc[rows["auc_20cm"].idxmax(), "value"]
            method = strategy_named(str(strategy), paper_head).method
            assert method is not None
            assert getattr(method, method.weight_field) == best
