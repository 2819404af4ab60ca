"""Small networks that are trained once, and what strategies learn from a few rooms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ..box_world import block_mean, box, shoot
from ..encoders import tiny_encoder
from .box_features import describe, learnable

if TYPE_CHECKING:
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.scenes import LearnedScenes
    from evercal.continual.store import NetworkStore
    from evercal.recordings.frame import Recording

    from ..conftest import Shared
    from .stages import EmptyScenes, MakeStore, Rooms

__all__ = ["block_mean", "box", "describe", "learnable", "shoot"]


FOLDERS = (
    "continual",
    "features",
    "geometry",
    "mapping",
    "recordings",
    "storage",
    "evaluation",
)


def pytest_itemcollected(item: pytest.Item) -> None:
    """The paper's system is tested when it, or a folder that it builds on, has changed."""
    folders = (f"src/evercal/{folder}" for folder in FOLDERS)
    item.add_marker(pytest.mark.slow("tests/continual", *folders))


@pytest.fixture(scope="session")
def empty_scenes() -> EmptyScenes:
    """Make `LearnedScenes` without scenes, with tiny random networks, for a strategy."""
    import torch

    from evercal.continual.networks.descriptor import GlobalDescriptor
    from evercal.continual.scenes import LearnedScenes

    torch.manual_seed(0)
    encoder = tiny_encoder()
    descriptor = GlobalDescriptor(8, maps=2, hidden=4, width=8).eval()
    for parameter in descriptor.parameters():
        parameter.data = parameter.data.half().float()  # as they are stored
    return lambda strategy: LearnedScenes(encoder, descriptor, strategy, 48)


@pytest.fixture(scope="session")
def first_stages(
    empty_scenes: EmptyScenes, rooms: Rooms, quick: StageOptions
) -> dict[str, LearnedScenes]:
    """Every strategy that learns scene by scene after the first room."""
    from evercal.continual.strategies import STRATEGIES

    from .stages import learn

    return {
        name: learn(empty_scenes(name), strategy, rooms[0], quick)
        for name, strategy in STRATEGIES.items()
        if strategy.method is not None and not strategy.jointly
    }


@pytest.fixture(scope="session")
def three_stages(
    first_stages: dict[str, LearnedScenes], rooms: Rooms, quick: StageOptions
) -> dict[str, list[LearnedScenes]]:
    """By strategy: what is learned after one, two and three rooms."""
    from evercal.continual.strategies import STRATEGIES

    from .stages import learn

    stages: dict[str, list[LearnedScenes]] = {}
    for name in ("sars_pixels", "isolation"):
        stages[name] = [first_stages[name].copy_for_training()]
        for room in rooms[1:]:
            stages[name].append(learn(stages[name][-1], STRATEGIES[name], room, quick))
        for after in stages[name]:
            after.scenes = [
                replace(record, inlier_threshold=0.01 * (i + 1), covariance_scale=1.5)
                for i, record in enumerate(after.scenes)
            ]
    return stages


@pytest.fixture(scope="session")
def make_store() -> MakeStore:
    """Make a store of given stages, as `learn_networks` does."""
    from evercal.continual.store import NetworkStore

    def make(root: Path, stages: Sequence[LearnedScenes]) -> NetworkStore:
        first = stages[0]
        empty = replace(first, heads=[], scenes=[], keyframes=[], method_states=[])
        store = NetworkStore(root, empty)
        for scenes in stages:
            store.commit(scenes, {"scene": scenes.scenes[-1].name, "seconds": 1.5})
        return store

    return make


@pytest.fixture(scope="session")
def arc_scenes(
    arcs: tuple[Recording, Recording], arc_stage: StageOptions, shared: Shared
) -> tuple[LearnedScenes, LearnedScenes]:
    """Networks after the first arc, and after both."""
    from evercal.continual.networks.descriptor import DESCRIBED_ENCODER, load_descriptor
    from evercal.continual.scenes import LearnedScenes
    from evercal.continual.strategies import STRATEGIES
    from evercal.features.encoder import load_encoder

    from .stages import learn

    def train() -> tuple[LearnedScenes, LearnedScenes]:
        strategy = STRATEGIES["sars_pixels"]
        options = replace(arc_stage, fit=replace(arc_stage.fit, iterations=450))
        encoder = load_encoder(DESCRIBED_ENCODER)
        empty = LearnedScenes(encoder, load_descriptor(), strategy.name, 120)
        one = learn(empty, strategy, arcs[0], options)
        return one, learn(one, strategy, arcs[1], options)

    return shared("arc_scenes", train)
