"""Strategies from a user's file."""

import importlib.util
import sys
from pathlib import Path

from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.errors import InputError


def load_plugin(path: Path) -> tuple[str, ...]:
    """Run a Python file and add the strategies of its dict `STRATEGIES` (name -> Strategy).

    Returns:
        The added names.
    """
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
    usable = isinstance(strategies, dict) and all(
        isinstance(strategy, Strategy) and strategy.name == name
        for name, strategy in strategies.items()
    )
    if not usable or not strategies:
        raise InputError(
            f"plugin {path}: defines no STRATEGIES; define a dict from names to Strategy records"
            " of these names"
        )
    for name, strategy in strategies.items():
        if STRATEGIES.get(name, strategy) is not strategy:
            raise InputError(f"plugin {path}: strategy {name!r} exists; choose another name")
    STRATEGIES.update(strategies)
    return tuple(strategies)
