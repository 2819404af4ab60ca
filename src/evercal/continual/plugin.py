"""Strategies from a user's own file."""

import importlib.util
import sys
from pathlib import Path

from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.errors import InputError


def load_plugin(path: Path) -> tuple[str, ...]:
    """Runs a Python file and adds the strategies that it names to `STRATEGIES`.

    Args:
        path: a file with a dict `STRATEGIES` of its own, names to `Strategy` records of these
            names.

    Returns:
        The names added.

    Raises:
        InputError: no such file, an error in it, no such dict, or a name that is taken.
    """
    if not path.is_file():
        raise InputError(f"plugin {path}: no such file")
    spec = importlib.util.spec_from_file_location(f"evercal_plugin_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"plugin {path}: not a Python file; give one that ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickles look for their module there
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"plugin {path}: {type(error).__name__}: {error}") from error
    found = getattr(module, "STRATEGIES", None)
    usable = isinstance(found, dict) and all(
        isinstance(v, Strategy) and v.name == name for name, v in found.items()
    )
    if not usable or not found:
        raise InputError(
            f"plugin {path}: defines no STRATEGIES; give a dict of names to Strategy records of"
            " these names"
        )
    taken = [name for name in found if name in STRATEGIES and STRATEGIES[name] is not found[name]]
    if taken:
        raise InputError(f"plugin {path}: strategy {taken[0]!r} is evercal's own; choose another")
    STRATEGIES.update(found)
    return tuple(found)
