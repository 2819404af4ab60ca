"""Recordings of small rooms and a map, each made once.

`rooms` are 64x48 pixels, for tests that need no pose. `arcs` are short camera arcs at 160x120.
`hall` is an arc at 320x240 with fine textures: its map locates images to a millimetre. Libraries
are imported inside the fixtures, after their number of threads is set: tests run side by side, and
small matrix products are slower with more threads.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from filelock import FileLock
from hypothesis import settings

os.environ["OMP_NUM_THREADS"] = "1"
# The same precision of networks on every machine, so that a bound holds on all of them.
os.environ["EVERCAL_PRECISION"] = "float32"
# Empty: the processor's kernels. The command line would choose others for all tests after it, but
# not for the products of numpy or of child processes.
os.environ |= {"OPENBLAS_CORETYPE": "", "MKL_CBWR": ""}

from .chromium import CHROMIUM, chromium
from .slow import pytest_addoption, pytest_collection_modifyitems, pytest_sessionfinish
from .windows import windows

__all__ = (
    "pytest_addoption",
    "pytest_collection_modifyitems",
    "pytest_sessionfinish",
    "windows",
)

if TYPE_CHECKING:
    import torch

    from evercal.continual.learning.stage import StageOptions
    from evercal.mapping.built_map import BuiltMap
    from evercal.mapping.scene_map import MapContents
    from evercal.recordings.frame import Recording
    from evercal.simulation.box_room import BoxRoom

# An example takes longer on a busy machine.
settings.register_profile("busy", deadline=None)
settings.load_profile("busy")


def _room(
    seed: int,
    name: str,
    size: tuple[int, int],
    span: int,
    every: int = 1,
    texture_px: int = 96,
) -> Recording:
    """`span` views on a walk of half a metre that turns by 50 degrees; each `every`th trains."""
    import numpy as np

    from evercal.recordings.frame import Frame, Recording
    from evercal.simulation.box_room import BoxRoom, default_camera, look_at

    room = BoxRoom(seed, texture_px=texture_px)
    camera = default_camera(*size)
    frames = []
    for i, s in enumerate(np.linspace(0, 1, span)):
        sway = np.sin(2 * np.pi * s)
        heading = seed + 0.9 * s
        eye = np.array([0.5 * s - 0.25, 0.15 * sway, 1.3 + 0.1 * sway])
        ahead = np.array([np.cos(heading), np.sin(heading), 0.1 * sway - 0.1])
        pose = look_at(eye, eye + ahead, 0.1 * sway)
        frames.append(Frame(f"{name}-{i:03d}", room.render(camera, pose), camera, pose))
    train = tuple(frames[::every])
    return Recording(name, train, tuple(f for i, f in enumerate(frames) if i % every))


Shared = Callable[[str, Callable[[], Any]], Any]


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    """Makes something once for all processes of a test run; it is kept on disk."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root

    def get(name: str, make: Callable[[], Any]) -> Any:
        file = root / f"{name}.pickle"
        with FileLock(root / f"{name}.lock"):
            if not file.exists():
                file.write_bytes(pickle.dumps(make()))
        return pickle.loads(file.read_bytes())

    return get


@pytest.fixture(scope="session")
def cell(shared: Shared, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packaged robot cell, learned: a folder with `cell.evercal` and `wrist.json`."""
    from evercal.cli import main
    from evercal.recordings.samples import CELL

    def learn() -> Path:
        root = tmp_path_factory.mktemp("cell")
        words = ["learn", root / "cell.evercal", CELL / "wrist", "--calibration"]
        assert main([*map(str, words), str(root / "wrist.json")]) == 0
        return root

    return shared("cell", learn)


@pytest.fixture
def cuda() -> torch.device:
    """A CUDA device, for tests marked `gpu`; the test is skipped without one."""
    import torch

    from evercal.continual.networks.device import device_of

    if not torch.cuda.is_available():
        pytest.skip("this machine has no CUDA device")
    return device_of("cuda")


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """The CPU, and with `-m gpu` a CUDA device; the test is skipped without one."""
    import torch

    return (
        request.getfixturevalue("cuda")
        if request.param == "cuda"
        else torch.device("cpu")
    )


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processor cores, whatever the machine has."""
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)


@pytest.fixture(scope="session")
def rooms() -> tuple[Recording, Recording, Recording]:
    """Three scenes of 30 frames, 64x48 pixels."""
    alpha, beta, gamma = (
        _room(seed, name, (64, 48), 30)
        for seed, name in ((31, "alpha"), (32, "beta"), (33, "gamma"))
    )
    return alpha, beta, gamma


@pytest.fixture(scope="session")
def arcs() -> tuple[Recording, Recording]:
    """Two scenes of 24 training and 24 test frames in between, 160x120 pixels."""
    one, two = (
        _room(seed, name, (160, 120), 48, 2)
        for seed, name in ((34, "one"), (31, "two"))
    )
    return one, two


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
def hall_built(hall: Recording, shared: Shared) -> BuiltMap:
    """The map of `hall` with 7 keyframes; its scatter is fitted to three test frames."""
    from evercal.features.encoder import load_encoder
    from evercal.learning.stated_scatter import with_scatter
    from evercal.mapping.build import MapOptions, build_map
    from evercal.mapping.memory_budget import MemoryBudget
    from evercal.mapping.scene_map import MapContents

    def build() -> BuiltMap:
        encoder = load_encoder()
        options = MapOptions(memory=MemoryBudget(share=0.25))
        built = build_map("hall", hall.train, encoder, options)
        contents = MapContents(encoder, options.size.cells, [built.scene])
        return replace(built, scene=with_scatter(contents, hall.test[::10]))

    return shared("hall", build)


@pytest.fixture(scope="session")
def hall_map(hall_built: BuiltMap) -> MapContents:
    """A map with `hall` as its only scene."""
    from evercal.features.encoder import load_encoder
    from evercal.mapping.scene_map import MapContents

    return MapContents(load_encoder(), 240, [hall_built.scene])


@pytest.fixture(scope="session")
def tree() -> Callable[[Path], dict[str, str]]:
    """Checksums of the files in a folder, by relative path."""

    def checksums(root: Path) -> dict[str, str]:
        return {
            str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(root.rglob("*"))
            if path.is_file()
        }

    return checksums


@pytest.fixture(scope="session")
def quick() -> StageOptions:
    """A stage of eight steps for `rooms`."""
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.networks.buffer import EncodePlan
    from evercal.continual.networks.head import HeadOptions
    from evercal.continual.networks.trainer import FitOptions
    from evercal.features.views import ViewOptions

    return StageOptions(
        head=HeadOptions(width=16, centres_per_scene=3),
        fit=FitOptions(iterations=8, batch=64, replay_batch=32),
        encode=EncodePlan(views_per_frame=2, cells=24, view=ViewOptions(short_side=48)),
        replay_views_per_frame=2,
    )


@pytest.fixture(scope="session")
def arc_stage() -> StageOptions:
    """Enough training for `arcs`."""
    from evercal.continual.learning.stage import StageOptions
    from evercal.continual.networks.buffer import EncodePlan
    from evercal.continual.networks.head import HeadOptions
    from evercal.continual.networks.trainer import FitOptions
    from evercal.features.views import ViewOptions

    return StageOptions(
        head=HeadOptions(width=64),
        fit=FitOptions(iterations=600, batch=384, replay_batch=256, peak_rate=7e-3),
        encode=EncodePlan(views_per_frame=2, view=ViewOptions(short_side=120)),
    )


@pytest.fixture
def every_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Path, Callable[[], object]], list[Path]]:
    """Run something on a folder and copy the folder before each of its steps.

    A step is a call that changes names on disk or syncs them. Files are linked, not copied: a
    store never writes into a file that is in place.
    """

    def record(root: Path, action: Callable[[], object]) -> list[Path]:
        snapshots: list[Path] = []
        copying = [False]

        def copy() -> None:
            copying[0] = True
            snapshots.append(tmp_path / "steps" / f"{len(snapshots):04d}" / "store")
            if root.exists():
                shutil.copytree(root, snapshots[-1], copy_function=os.link)
            copying[0] = False

        def watched(function: Callable[..., object]) -> Callable[..., object]:
            def call(*args: object, **kwargs: object) -> object:
                if not copying[0]:
                    copy()
                return function(*args, **kwargs)

            return call

        with monkeypatch.context() as patch:
            for name in ("replace", "fsync", "unlink", "rmdir", "mkdir"):
                patch.setattr(os, name, watched(getattr(os, name)))
            action()
        copy()
        return snapshots

    return record


@pytest.fixture
def full_disk(
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., AbstractContextManager[list[str]]]:
    """A disk where the n-th operation that needs space fails, and all later ones or only it.

    The context holds the names of the operations so far.
    """

    real_open = open

    @contextmanager
    def full(last: int, once: bool = False) -> Iterator[list[str]]:
        calls: list[str] = []

        def failing(function: Callable[..., object]) -> Callable[..., object]:
            def call(*args: Any, **kwargs: Any) -> object:
                mode = args[1] if len(args) > 1 else kwargs.get("mode", "r")
                if function is real_open and not set(mode) & set("wxa+"):
                    return function(*args, **kwargs)
                calls.append(function.__name__)
                if len(calls) == last or (len(calls) > last and not once):
                    named = args[:1] if function.__name__ != "fsync" else ()
                    raise OSError(28, "No space left on device", *named)
                return function(*args, **kwargs)

            return call

        with monkeypatch.context() as patch:
            for name in ("replace", "fsync", "mkdir", "rename"):
                patch.setattr(os, name, failing(getattr(os, name)))
            opening = failing(real_open)
            patch.setattr("builtins.open", opening)
            patch.setattr("io.open", opening)
            yield calls

    return full


@pytest.fixture
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are written but not synced, for tests without a power cut: a sync takes long.

    What is synced must still be open.
    """
    monkeypatch.setattr(os, "fsync", os.fstat)


@pytest.fixture
def snapshot() -> Callable[[Path], dict[str, bytes | None]]:
    """Every file and folder below a folder with its content."""

    def take(folder: Path) -> dict[str, bytes | None]:
        return {
            str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
            for path in sorted(folder.rglob("*"))
        }

    return take


@pytest.fixture
def everything(
    snapshot: Callable[[Path], dict[str, bytes | None]],
) -> Callable[[Path], dict[str, bytes | None]]:
    """As `snapshot`; locks are left out."""
    return lambda root: {
        n: c for n, c in snapshot(root).items() if not n.endswith(".lock")
    }


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, rendering in software."""
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium")
    with chromium() as started:
        yield started


@pytest.fixture(scope="session")
def cluster() -> Iterator[Any]:
    """A Ray cluster of two nodes with a core each."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    made.add_node(num_cpus=1)
    yield made
    made.shutdown()
