"""The list of strategies: what each is, in plain data, and that they hang together."""

import json
from dataclasses import fields, replace
from pathlib import Path

import pytest

import evercal
from evercal.continual.methods.controls import FineTuning
from evercal.continual.methods.method import Method, described
from evercal.continual.methods.penalties import Distillation, OldOutput, Penalty
from evercal.continual.methods.preconditioning import PreconditionedReplay
from evercal.continual.methods.replay import Replay
from evercal.continual.selectors import SELECTORS
from evercal.continual.strategies import STRATEGIES, Strategy, strategy_named
from evercal.errors import InputError


@pytest.mark.parametrize(("name", "strategy"), STRATEGIES.items())
def test_every_strategy_says_where_it_is_from_and_hangs_together(
    name: str, strategy: Strategy
) -> None:
    assert strategy.name == name
    assert name.isidentifier()
    assert len(strategy.citation.split()) >= 4
    assert strategy.method is not None or strategy.builds_map
    if isinstance(strategy.method, Replay):
        assert strategy.method.selector in SELECTORS
        assert strategy.method.replays
        assert strategy.method.weight > 0
    if strategy.jointly:
        assert strategy.method == FineTuning()


@pytest.mark.parametrize("strategy", STRATEGIES.values(), ids=lambda s: s.name)
def test_a_description_is_plain_data_and_tells_all_hyper_parameters(strategy: Strategy) -> None:
    told = strategy.description()
    assert json.loads(json.dumps(told)) == told
    assert told["map"] == strategy.builds_map
    assert told.get("jointly", False) == strategy.jointly
    if strategy.method is None:
        assert told["method"] is None
        return
    method = told["method"]
    assert isinstance(method, dict)
    assert method["kind"] == type(strategy.method).__name__
    assert method.keys() - {"kind"} == {field.name for field in fields(strategy.method)}


def test_no_two_strategies_are_the_same() -> None:
    told = [json.dumps(strategy.description(), sort_keys=True) for strategy in STRATEGIES.values()]
    assert len(set(told)) == len(told)


def test_a_description_goes_down_into_penalties() -> None:
    told = described(Replay("sars", Distillation(scale=3.0), 0.5))
    penalty = told["penalty"]
    assert isinstance(penalty, dict)
    assert (told["selector"], told["weight"], told["every_scene"]) == ("sars", 0.5, True)
    assert (penalty["kind"], penalty["scale"]) == ("Distillation", 3.0)
    assert penalty["options"]["active_centres"] == 50


def test_every_hyper_parameter_has_a_default_and_a_line_about_it() -> None:
    """One file a family, a frozen dataclass each, with its citation."""
    folder = Path(evercal.__file__).parent / "continual" / "methods"
    text = "\n".join(path.read_text() for path in sorted(folder.glob("*.py")))
    for strategy in STRATEGIES.values():
        method = strategy.method
        if method is None:
            continue
        assert type(method)()  # defaults
        assert type(method).__dataclass_params__.frozen  # type: ignore[attr-defined]
        assert type(method).citation
        assert f"class {type(method).__name__}(" in text


def test_fine_tuning_differs_from_replay_in_nothing_but_replay() -> None:
    control = STRATEGIES["finetune"]
    assert control.method == FineTuning()
    for name in ("select", "begin", "after_scene"):
        assert getattr(FineTuning, name) is getattr(Method, name)
    assert not control.builds_map


def test_the_three_of_ours_are_a_map_a_network_and_both() -> None:
    ours, network, both = (STRATEGIES[f"evercal{tail}"] for tail in ("", "_network", "_hybrid"))
    assert (ours.method, ours.builds_map) == (None, True)
    assert network.method == PreconditionedReplay()
    assert replace(both, name=network.name, builds_map=False) == network


def test_neighbours_differ_in_what_their_names_say() -> None:
    def method(name: str) -> Method:
        found = STRATEGIES[name].method
        assert found is not None
        return found

    def alike(one: str, other: str, **changes: object) -> bool:
        """But for the one setting that each of them has tuned."""
        tuned = {"weight", "alpha"}
        a, b = (described(method(name)) for name in (one, other))
        a |= {k: described(v) if isinstance(v, Penalty) else v for k, v in changes.items()}
        return {k: v for k, v in a.items() if k not in tuned} == {
            k: v for k, v in b.items() if k not in tuned
        }

    assert alike("er", "icarl", selector="herding", penalty=OldOutput())
    assert not alike("er", "icarl", selector="herding")
    assert alike("er", "gdr", selector="leverage")
    assert alike("er", "gss", selector="gradients")
    assert alike("gec", "gec_moving", moving=True)
    assert alike("ewc", "ewc_online", running=True)
    assert alike("sars_spdd", "sars_spdd_filled", selector="sars_filled")


def test_the_paper_is_replayed_as_it_is_printed() -> None:
    """SARS with the fixed radius, the teacher alone, all weights 1, tau 2, 50 active centres."""
    method = STRATEGIES["sars_spdd"].method
    assert isinstance(method, Replay)
    assert method == Replay("sars", Distillation(), weight=1.0)
    assert isinstance(method.penalty, Distillation)
    options = method.penalty.options
    assert (options.prior_weight, options.metric_weight, options.output_weight) == (1, 1, 1)
    assert (options.temperature, options.active_centres, method.penalty.scale) == (2.0, 50, 1.0)


def test_a_name_that_is_none_is_told_with_those_there_are() -> None:
    assert strategy_named("er") is STRATEGIES["er"]
    for name in ("nonsense", "sars+spdd", "er@0.3", ""):
        with pytest.raises(InputError, match=r"unknown; choose one of evercal, .* joint_map"):
            strategy_named(name)
