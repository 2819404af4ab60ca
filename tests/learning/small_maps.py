"""Maps that are learned fast, of many recordings."""

from __future__ import annotations

from pathlib import Path

from evercal.map import Map
from evercal.mapping.build import MapOptions
from evercal.mapping.store import MapStore
from evercal.recordings import Recording

Rooms = tuple[Recording, ...]
QUICK = MapOptions(adjust=False)


def small_map(root: Path, encoder: Path | None = None) -> Map:
    """A new map that encodes images at 64 pixels, which is fast."""
    return Map(MapStore.create(root, encoder, short_side=64))
