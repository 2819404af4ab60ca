"""What the strategies know after some rooms, and stores that hold it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from evercal.continual.knowledge import Knowledge
    from evercal.continual.learn import StageOptions
    from evercal.continual.robot import Robot
    from evercal.datasets.frame import Scene

    Blank = Callable[[str], Knowledge]
    Rooms = tuple[Scene, Scene, Scene]


@pytest.fixture(scope="session")
def first(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, Knowledge]:
    """What each strategy knows after `alpha`."""
    from evercal.continual.learn import Stage, learn
    from evercal.continual.strategies import STRATEGIES

    found = {}
    for name in STRATEGIES:
        *_, stage = learn(blank(name), rooms[0], quick)
        assert isinstance(stage, Stage)
        found[name] = stage.knowledge
    return found


@pytest.fixture(scope="session")
def taught(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, list[Knowledge]]:
    """By strategy: what is known after one, two and three rooms."""
    from evercal.continual.learn import Stage, learn
    from evercal.continual.robot import with_fit

    found: dict[str, list[Knowledge]] = {}
    for strategy in ("evercal", "isolation"):
        known, after = blank(strategy), []
        for scene in rooms:
            *_, stage = learn(known, scene, quick)
            assert isinstance(stage, Stage)
            known = stage.knowledge
            known.scenes[-1] = with_fit(known.scenes[-1], 0.01 * len(known.scenes), 1.5)
            after.append(known)
        found[strategy] = after
    return found


@pytest.fixture(scope="session")
def make() -> Callable[[Path, list[Knowledge]], Robot]:
    """Makes a store with given stages, the way `teach` does."""
    import torch

    from evercal.continual.learn import Checkpoint
    from evercal.continual.robot import Robot

    def store(root: Path, stages: list[Knowledge]) -> Robot:
        first = stages[0]
        robot = Robot(root, replace(first, heads=[], scenes=[], memories=[]), [], None)
        for known in stages:
            robot.begin({"scene": known.scenes[-1].name})
            robot.checkpoint(Checkpoint({"a": torch.zeros(3)}, {"b": torch.ones(2)}))
            robot.commit(known, {"scene": known.scenes[-1].name, "seconds": 1.5})
        return robot

    return store


@pytest.fixture(scope="session")
def answers(rooms: Rooms) -> Callable[[Knowledge], list[bytes]]:
    """Tells what a robot says to an image of each room, to the last bit."""
    from evercal.localization.localizer import LocalizeOptions, Localizer
    from evercal.localization.pnp import PnpOptions

    # Networks this small are wide of the mark: only generous bounds give poses to compare.
    wide = PnpOptions(threshold_px=20.0)

    def ask(known: Knowledge) -> list[bytes]:
        localizer, said = Localizer(known, LocalizeOptions(pnp=wide, refine=wide)), []
        for scene in rooms:
            frame = scene.train[0]
            found = localizer.localize(frame.read_image(), frame.camera)
            pose = found.base_from_camera
            numbers = b"" if pose is None else pose.matrix().tobytes()
            assert found.inliers > 0, "an answer without a pose would be like any other"
            said.append(repr((found.status, found.scene, found.inliers)).encode() + numbers)
        return said

    return ask
