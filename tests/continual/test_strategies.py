"""The list of strategies and their descriptions."""

import json
from dataclasses import fields

import pytest

from evercal.continual.methods.method import FineTuning
from evercal.continual.methods.penalties import Distillation
from evercal.continual.methods.replay import Replay
from evercal.continual.selection.selectors import SELECTORS
from evercal.continual.strategies import STRATEGIES, Strategy, strategy_named
from evercal.errors import InputError


@pytest.mark.parametrize(("name", "strategy"), STRATEGIES.items())
def test_strategies_are_consistent(name: str, strategy: Strategy) -> None:
    assert strategy.name == name
    assert name.isidentifier()
    assert len(strategy.citation.split()) >= 4
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


def test_strategies_are_distinct() -> None:
    records = [
        json.dumps(strategy.description(), sort_keys=True) for strategy in STRATEGIES.values()
    ]
    assert len(set(records)) == len(records)


def test_sars_spdd_has_the_settings_of_the_paper() -> None:
    """SARS with the fixed radius, SPDD with weights 1, tau 2 and 50 active centres."""
    method = STRATEGIES["sars_spdd"].method
    assert isinstance(method, Replay)
    assert method == Replay("sars", Distillation(), weight=1.0)
    assert isinstance(method.penalty, Distillation)
    options = method.penalty.options
    assert (options.prior_weight, options.metric_weight, options.output_weight) == (1, 1, 1)
    assert (options.temperature, options.active_centres, method.penalty.scale) == (2.0, 50, 1.0)


def test_unknown_strategy_is_refused() -> None:
    assert strategy_named("er") is STRATEGIES["er"]
    for name in ("nonsense", "sars+spdd", "er@0.3", ""):
        with pytest.raises(InputError, match=r"unknown; choose one of evercal, .* joint"):
            strategy_named(name)
