"""Small rooms and small networks, made once.

Three sizes. `rooms` are 64x48 pixels with random networks, for all that does not depend on what was
learned. `arcs` are short camera arcs at 160x120 with the shipped networks: a few hundred steps of
training locate their images to some centimetres. `hall` is an arc at 320x240 with fine textures:
its map locates images to a millimetre. torch is imported inside the fixtures only, after its number
of threads is set: tests run side by side, and small products are slower with more threads.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

os.environ["OMP_NUM_THREADS"] = "1"

if TYPE_CHECKING:
    import torch

    from evercal.continual.stage import Stage, StageOptions
    from evercal.mapping.scene_maps import SceneMaps
    from evercal.mapping.store import Store
    from evercal.recordings.frame import Recording
    from evercal.simulation.box_room import BoxRoom


def _room(
    seed: int, name: str, size: tuple[int, int], span: int, every: int = 1, texture_px: int = 96
) -> Recording:
    """A walk of half a metre, turning by 50 degrees; every `every`-th view of `span` is learned.

    The other views are there to test.
    """
    import numpy as np

    from evercal.recordings.frame import Frame, Recording
    from evercal.simulation.box_room import BoxRoom, default_camera, look_at

    room, camera = BoxRoom(seed, texture_px=texture_px), default_camera(*size)
    frames = []
    for i, s in enumerate(np.linspace(0, 1, span)):
        sway, heading = np.sin(2 * np.pi * s), seed + 0.9 * s
        eye = np.array([0.5 * s - 0.25, 0.15 * sway, 1.3 + 0.1 * sway])
        ahead = np.array([np.cos(heading), np.sin(heading), 0.1 * sway - 0.1])
        pose = look_at(eye, eye + ahead, 0.1 * sway)
        frames.append(Frame(f"{name}-{i:03d}", room.render(camera, pose), camera, pose))
    train = tuple(frames[::every])
    return Recording(name, train, tuple(f for i, f in enumerate(frames) if i % every))


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """The CPU, and with `-m gpu` a CUDA device; without one the test is skipped."""
    import torch

    from evercal.features.device import device_of

    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("PyTorch finds no CUDA device on this machine")
    return device_of(request.param)


@pytest.fixture(scope="session")
def rooms() -> tuple[Recording, Recording, Recording]:
    """Three scenes of 30 frames, 64x48 pixels."""
    alpha, beta, gamma = (
        _room(seed, name, (64, 48), 30)
        for seed, name in ((31, "alpha"), (32, "beta"), (33, "gamma"))
    )
    return alpha, beta, gamma


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
def quick_vlad() -> Iterator[None]:
    """Tiny encoders get random centroids at once; rooms for better ones take seconds to draw."""
    import torch

    from evercal.features import vlad
    from evercal.features.encoder import Encoder

    whole = vlad.fit_centroids

    def quick(encoder: Encoder) -> torch.Tensor:
        if encoder.width > 8:
            return whole(encoder)
        drawn = torch.randn(4, encoder.width, generator=torch.Generator().manual_seed(0))
        return torch.nn.functional.normalize(drawn, dim=1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vlad, "fit_centroids", quick)
        yield


@pytest.fixture(scope="session")
def blank(quick_vlad: None) -> Callable[[str], SceneMaps]:
    """Makes a robot that knows nothing, with tiny random networks, given its strategy."""
    import torch

    from evercal.continual.networks.descriptor import GlobalDescriptor
    from evercal.features.encoder import LocalEncoder
    from evercal.mapping.scene_maps import SceneMaps

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
    from evercal.continual.learn import learn
    from evercal.continual.stage import Stage
    from evercal.continual.strategies import STRATEGIES
    from evercal.mapping.scene_maps import with_fit

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
def arcs() -> tuple[Recording, Recording]:
    """Two scenes of 24 training and 24 test frames in between, 160x120 pixels."""
    one, two = (_room(seed, name, (160, 120), 48, 2) for seed, name in ((34, "one"), (31, "two")))
    return one, two


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
    from evercal.continual.learn import learn
    from evercal.continual.networks.descriptor import load_descriptor
    from evercal.continual.stage import Stage
    from evercal.continual.strategies import STRATEGIES
    from evercal.features.encoder import load_encoder
    from evercal.mapping.scene_maps import SceneMaps

    maps = [SceneMaps(load_encoder(), load_descriptor(), "evercal_network", 120)]
    for arc in arcs:
        *_, stage = learn(maps[-1], STRATEGIES["evercal_network"], arc, arc_stage)
        assert isinstance(stage, Stage)
        maps.append(stage.maps)
    return maps[1], maps[2]


HALL_SEED = 34


@pytest.fixture(scope="session")
def hall() -> Recording:
    """A scene of 30 training and 30 test frames in between, 320x240 pixels, fine textures."""
    return _room(HALL_SEED, "hall", (320, 240), 60, 2, 256)


@pytest.fixture(scope="session")
def hall_room() -> BoxRoom:
    """The room of `hall`, for other views of it."""
    from evercal.simulation.box_room import BoxRoom

    return BoxRoom(HALL_SEED, texture_px=256)


@pytest.fixture(scope="session")
def hall_stage(hall: Recording) -> Stage:
    """The map of `hall` with 7 keyframes; the thresholds of its record are fitted."""
    from evercal.continual.learn import learn
    from evercal.continual.networks.descriptor import load_descriptor
    from evercal.continual.stage import Stage, StageOptions
    from evercal.continual.strategies import STRATEGIES
    from evercal.features.encoder import load_encoder
    from evercal.localization.acceptance import fitted_record
    from evercal.mapping.scene_maps import SceneMaps

    nothing = SceneMaps(load_encoder(), load_descriptor(), "evercal", 240)
    options = StageOptions(memory_share=0.25)
    *_, stage = learn(nothing, STRATEGIES["evercal"], hall, options)
    assert isinstance(stage, Stage)
    stage.maps.scenes[0] = fitted_record(stage.maps, hall.test[::10])
    return stage


@pytest.fixture(scope="session")
def hall_maps(hall_stage: Stage) -> SceneMaps:
    """What is known after `hall`."""
    return hall_stage.maps


@pytest.fixture(scope="session")
def tree() -> Callable[[Path], dict[str, str]]:
    """Lists a folder: checksum of every file in it, by relative path."""

    def checksums(root: Path) -> dict[str, str]:
        return {
            str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(root.rglob("*"))
            if path.is_file()
        }

    return checksums
