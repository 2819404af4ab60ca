"""Strategies by name, and those of a user's file."""

import importlib.util
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TypeGuard

from evercal.classes import frozen
from evercal.continual.methods.ewc import ElasticWeightConsolidation
from evercal.continual.methods.gec import EpisodicConstraint
from evercal.continual.methods.method import FineTuning, Isolation, Method, described
from evercal.continual.methods.mir import MaximallyInterferedRetrieval
from evercal.continual.methods.penalties import (
    BoundedByTeacher,
    Distillation,
    OldOutput,
    OldPixels,
    Relations,
)
from evercal.continual.methods.replay import Replay
from evercal.errors import InputError
from evercal.typing import JsonObject, Strings


@frozen
class Strategy:
    """What learning a scene does."""

    name: str
    """Name in stores and results."""
    method: Method | None = None
    """Method that trains the network; None for a map."""
    jointly: bool = False
    """Whether all scenes are trained at once, as a reference for the others."""

    def weighted(self, weight: float) -> "Strategy":
        """Copy the strategy with another weight of what protects earlier scenes."""
        if not 0 <= weight < math.inf:
            raise InputError(f"`weight` {weight}: give a number >= 0")
        if not self.method or not self.method.weight_field:
            raise InputError(
                f"`weight` {weight}: strategy {self.name!r} protects no scene; omit it"
            )
        return replace(self, method=self.method.weighted(weight))

    def description(self) -> JsonObject:
        """Convert to plain data: method with hyper-parameters, map, joint training."""
        record: JsonObject = {"method": None, "map": self.method is None}
        if self.method:
            record["method"] = described(self.method)
        if self.jointly:
            record["jointly"] = True
        return record


# Weights with the best mean over the orders of `evercal bench sim-tune --tune`, see
# docs/methods.md; methods with the loss of another have its weight.
_METHODS: dict[str, Method | None] = {
    "evercal": None,
    "finetune": FineTuning(),
    "er": Replay(weight=3.0),
    "icarl": Replay("herding", OldOutput()),
    "buff_cs": Replay("coverage", BoundedByTeacher()),
    "gdr": Replay("leverage", weight=3.0),
    "gss": Replay("gradients", weight=3.0),
    "mir": MaximallyInterferedRetrieval(weight=3.0),
    "co2l": Replay("reservoir", Relations()),
    "gec": EpisodicConstraint(),
    "ewc": ElasticWeightConsolidation(),
    "sars_spdd": Replay("sars", Distillation(), weight=10.0),
    "sars_spdd_filled": Replay("sars_filled", Distillation(), weight=10.0),
    "reservoir_spdd": Replay("reservoir", Distillation(), weight=10.0),
    "sars_pixels": Replay("sars_filled", OldPixels(), weight=3.0),
    "sars_old_output": Replay("sars", OldOutput()),
    "sars_reprojection": Replay("sars", weight=3.0),
    "isolation": Isolation(),
    "joint": FineTuning(),
}
STRATEGIES: dict[str, Strategy] = {
    name: Strategy(name, method, name == "joint") for name, method in _METHODS.items()
}


ON_PAPER_HEAD = dict.fromkeys(("sars_spdd", "sars_spdd_filled", "reservoir_spdd"), 1.0)
"""Weights on the paper's network, where they differ: the paper's, which tuning confirms."""


def strategy_named(name: str, paper_head: bool = False) -> Strategy:
    """Return a strategy by name, with the weight that was tuned on our network or the paper's."""
    if name not in STRATEGIES:
        names = ", ".join(STRATEGIES)
        raise InputError(
            f"strategy {name!r}: unknown; choose one of {names}, or name the file that defines it"
            " by `plugin`"
        )
    strategy = STRATEGIES[name]
    if paper_head and name in ON_PAPER_HEAD:
        return strategy.weighted(ON_PAPER_HEAD[name])
    return strategy


def load_plugin(path: Path) -> Strings:
    """Run a Python file, add the strategies of its dict `STRATEGIES`, and return their names."""
    spec = importlib.util.spec_from_file_location(f"evercal_plugin_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise InputError(f"plugin {path}: not a Python file; give one that ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickle look up the module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"plugin {path}: {type(error).__name__}: {error}") from error
    strategies = getattr(module, "STRATEGIES", None)
    if not _is_named(strategies):
        raise InputError(
            f"plugin {path}: defines no STRATEGIES; define a dict from names to Strategy records"
            " of these names"
        )
    for name, strategy in strategies.items():
        if STRATEGIES.get(name, strategy) is not strategy:
            raise InputError(
                f"plugin {path}: strategy {name!r} exists; choose another name"
            )
    STRATEGIES.update(strategies)
    return tuple(strategies)


def _is_named(strategies: object) -> TypeGuard[dict[str, Strategy]]:
    """Whether strategies are a dict from names to records of these names, with one at least."""
    if not isinstance(strategies, dict) or not strategies:
        return False
    return all(
        isinstance(strategy, Strategy) and strategy.name == name
        for name, strategy in strategies.items()
    )
