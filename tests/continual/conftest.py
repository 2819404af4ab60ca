"""Small networks that are trained once, and what the strategies know after a room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from evercal.mapping.scene_maps import SceneMaps

    from evercal.continual.stage import StageOptions
    from evercal.mapping.store import Store
    from evercal.recordings.frame import Recording

    Blank = Callable[[str], SceneMaps]
    Rooms = tuple[Recording, Recording, Recording]


@pytest.fixture(scope="session")
def quick() -> StageOptions:
    """A stage of eight steps for `rooms`."""
    from evercal.continual.networks.buffer import EncodePlan
    from evercal.continual.networks.head import HeadOptions
    from evercal.continual.networks.trainer import FitOptions
    from evercal.continual.stage import StageOptions
    from evercal.features.views import ViewOptions

    return StageOptions(
        head=HeadOptions(width=16, centres_per_scene=3),
        fit=FitOptions(iterations=8, batch=64, replay_batch=32),
        encode=EncodePlan(views_per_frame=2, cells=24, view=ViewOptions(short_side=48)),
        replay_views_per_frame=2,
    )


@pytest.fixture(scope="session")
def blank() -> Callable[[str], SceneMaps]:
    """Makes a robot that knows nothing, with tiny random networks, given its strategy."""
    import torch
    from evercal.mapping.scene_maps import SceneMaps

    from evercal.continual.networks.descriptor import GlobalDescriptor
    from evercal.features.encoder import LocalEncoder

    torch.manual_seed(0)
    encoder = LocalEncoder(stem=(4, 4), inner=8, blocks=1, width=8).eval()
    descriptor = GlobalDescriptor(8, maps=2, hidden=4, width=8).eval()
    for parameter in (*encoder.parameters(), *descriptor.parameters()):
        parameter.data = parameter.data.half().float()  # as they are stored
    return lambda strategy: SceneMaps(encoder, descriptor, strategy, 48)


@pytest.fixture(scope="session")
def taught(
    blank: Callable[[str], SceneMaps],
    rooms: tuple[Recording, Recording, Recording],
    quick: StageOptions,
) -> dict[str, list[SceneMaps]]:
    """By strategy: what is known after one, two and three rooms."""
    from evercal.mapping.scene_maps import with_fit

    from evercal.continual.learn import learn
    from evercal.continual.stage import Stage
    from evercal.continual.strategies import STRATEGIES

    found: dict[str, list[SceneMaps]] = {}
    for strategy in ("evercal", "evercal_network", "isolation"):
        maps, after = blank(strategy), []
        for scene in rooms:
            *_, stage = learn(maps, STRATEGIES[strategy], scene, quick)
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

    from evercal.mapping.store import Checkpoint, Store

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
def answers(rooms: tuple[Recording, Recording, Recording]) -> Callable[..., list[bytes]]:
    """Tells what a robot says to an image of each room and keeps of it, to the last bit."""
    from evercal.localization.localizer import LocalizeOptions, Localizer
    from evercal.localization.pnp import PnpOptions

    # Networks this small are wide of the mark: only generous bounds give poses to compare.
    wide = PnpOptions(threshold_px=20.0)

    def ask(maps: SceneMaps, sure: bool | None = None) -> list[bytes]:
        # The encoder is too small for maps to answer, so what they hold is compared.
        sure = bool(maps.heads) if sure is None else sure
        localizer, said = Localizer(maps, LocalizeOptions(pnp=wide)), []
        for scene in rooms:
            frame = scene.train[0]
            found = localizer.localize(frame.read_image(), frame.camera)
            pose = found.base_from_camera
            numbers = b"" if pose is None else pose.matrix().tobytes()
            assert found.inliers > 0 or not sure, "an answer without a pose would be like any other"
            said.append(repr((found.status, found.scene, found.inliers)).encode() + numbers)
        for kept in maps.keyframes if not maps.heads else []:
            assert kept is not None
            assert kept.landmarks
            said += [value.numpy().tobytes() for value in kept.to_tensors().values()]
        return said

    return ask


@pytest.fixture(scope="session")
def arc_stage() -> StageOptions:
    """Enough training for `arcs`."""
    from evercal.continual.networks.buffer import EncodePlan
    from evercal.continual.networks.head import HeadOptions
    from evercal.continual.networks.trainer import FitOptions
    from evercal.continual.stage import StageOptions
    from evercal.features.views import ViewOptions

    return StageOptions(
        head=HeadOptions(width=64),
        fit=FitOptions(iterations=600, batch=384, replay_batch=256, peak_rate=7e-3),
        encode=EncodePlan(views_per_frame=2, view=ViewOptions(short_side=120)),
    )


@pytest.fixture(scope="session")
def arc_maps(
    arcs: tuple[Recording, Recording], arc_stage: StageOptions
) -> tuple[SceneMaps, SceneMaps]:
    """What is known after the first arc, and after both."""
    from evercal.mapping.scene_maps import SceneMaps

    from evercal.continual.learn import learn
    from evercal.continual.networks.descriptor import load_descriptor
    from evercal.continual.stage import Stage
    from evercal.continual.strategies import STRATEGIES
    from evercal.features.encoder import load_encoder

    maps = [SceneMaps(load_encoder(), load_descriptor(), "evercal_network", 120)]
    for arc in arcs:
        *_, stage = learn(maps[-1], STRATEGIES["evercal_network"], arc, arc_stage)
        assert isinstance(stage, Stage)
        maps.append(stage.maps)
    return maps[1], maps[2]


@pytest.fixture(scope="session")
def first(blank: Blank, rooms: Rooms, quick: StageOptions) -> dict[str, SceneMaps]:
    """What each strategy that learns scene by scene knows after `alpha`."""
    from evercal.continual.learn import learn
    from evercal.continual.stage import Stage
    from evercal.continual.strategies import STRATEGIES

    found = {}
    for name, strategy in STRATEGIES.items():
        if strategy.jointly:
            continue
        *_, stage = learn(blank(name), strategy, rooms[0], quick)
        assert isinstance(stage, Stage)
        found[name] = stage.maps
    return found
