"""Stores as arguments: a map, or a store of networks."""

from pathlib import Path
from typing import TYPE_CHECKING

from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedLocalizer
    from evercal.localization.localizer import Localizer

MAP = "evercal"
"""The strategy of a map."""


def strategy_of(store: Path) -> str | None:
    """The strategy that a store was made with; None if there is no store yet."""
    from evercal.storage import read_manifest
    from evercal.storage.stages import is_store

    return str(read_manifest(store)["strategy"]) if is_store(store) else None


def open_localizer(store: Path, device: str) -> "LearnedLocalizer":
    """The localizer of a store of either kind.

    Raises:
        InputError: Not a store, an empty one, or a damaged file; no such device.
    """
    if strategy_of(store) in (MAP, None):
        from evercal.localization.localizer import Localizer

        return Localizer.open(store, device=device)
    from evercal.continual.localizer import open_networks

    return open_networks(store, device)


def open_map(store: Path, device: str) -> "Localizer":
    """The localizer of a map.

    Raises:
        InputError: A store of networks, or as `open_localizer`.
    """
    strategy = strategy_of(store)
    if strategy not in (MAP, None):
        raise InputError(
            f"{store}: holds networks of strategy {strategy}, and this needs a map; learn the scene"
            " with the default strategy"
        )
    from evercal.localization.localizer import Localizer

    return Localizer.open(store, device=device)
