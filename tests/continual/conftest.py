"""What the strategies know after some rooms, and stores that hold it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from evercal.continual.learn import StageOptions
    from evercal.datasets.frame import Scene
    from evercal.mapping.scene_maps import SceneMaps
    from evercal.mapping.store import Store

    Blank = Callable[[str], SceneMaps]
    Rooms = tuple[Scene, Scene, Scene]


@pytest.fixture(scope="session")
def first(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, SceneMaps]:
    """What each strategy knows after `alpha`."""
    from evercal.continual.learn import Stage, learn
    from evercal.continual.strategies import STRATEGIES

    found = {}
    for name in STRATEGIES:
        *_, stage = learn(blank(name), rooms[0], quick)
        assert isinstance(stage, Stage)
        found[name] = stage.maps
    return found


@pytest.fixture(scope="session")
def taught(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, list[SceneMaps]]:
    """By strategy: what is known after one, two and three rooms."""
    from evercal.continual.learn import Stage, learn
    from evercal.mapping.store import with_fit

    found: dict[str, list[SceneMaps]] = {}
    for strategy in ("evercal", "isolation"):
        maps, after = blank(strategy), []
        for scene in rooms:
            *_, stage = learn(maps, scene, quick)
            assert isinstance(stage, Stage)
            maps = stage.maps
            maps.scenes[-1] = with_fit(maps.scenes[-1], 0.01 * len(maps.scenes), 1.5)
            after.append(maps)
        found[strategy] = after
    return found


@pytest.fixture(scope="session")
def make() -> Callable[[Path, list[SceneMaps]], Store]:
    """Makes a store with given stages, the way `teach` does."""
    import torch

    from evercal.continual.learn import Checkpoint
    from evercal.mapping.store import Store

    def store(root: Path, stages: list[SceneMaps]) -> Store:
        first = stages[0]
        store = Store(root, replace(first, heads=[], scenes=[], keyframes=[]), [], None)
        for maps in stages:
            store.begin({"scene": maps.scenes[-1].name})
            store.checkpoint(Checkpoint({"a": torch.zeros(3)}, {"b": torch.ones(2)}))
            store.commit(maps, {"scene": maps.scenes[-1].name, "seconds": 1.5})
        return store

    return store


@pytest.fixture(scope="session")
def answers(rooms: Rooms) -> Callable[[SceneMaps], list[bytes]]:
    """Tells what a robot says to an image of each room, to the last bit."""
    from evercal.localization.localizer import LocalizeOptions, Localizer
    from evercal.localization.pnp import PnpOptions

    # Networks this small are wide of the mark: only generous bounds give poses to compare.
    wide = PnpOptions(threshold_px=20.0)

    def ask(maps: SceneMaps) -> list[bytes]:
        localizer, said = Localizer(maps, LocalizeOptions(pnp=wide, refine=wide)), []
        for scene in rooms:
            frame = scene.train[0]
            found = localizer.localize(frame.read_image(), frame.camera)
            pose = found.base_from_camera
            numbers = b"" if pose is None else pose.matrix().tobytes()
            assert found.inliers > 0, "an answer without a pose would be like any other"
            said.append(repr((found.status, found.scene, found.inliers)).encode() + numbers)
        return said

    return ask
