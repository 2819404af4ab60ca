"""Recordings and maps on disk, and a way to run commands."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from evercal.cli import main

if TYPE_CHECKING:
    from evercal.mapping.scene_map import MapContents
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Ran:
    """Outcome of a command."""

    code: int
    out: str
    err: list[str]
    """Lines on stderr apart from progress bars."""


Run = Callable[..., Ran]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    def call(*words: object) -> Ran:
        capfd.readouterr()
        code = main([str(word) for word in words])
        out, err = capfd.readouterr()
        # A bar rewrites its line after a carriage return and ends it with a line break.
        lines = [
            line
            for line in err.split("\n")
            if line and not re.search(r"\r|it/s|/s\]", line)
        ]
        return Ran(code, out, lines)

    return call


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of the scenes `box-room-41` and `box-room-42`, 24 training and 6 test frames each."""
    from evercal.recordings import generic

    from ..box_world import box_room_scene

    root = tmp_path_factory.mktemp("rooms")
    for seed in (41, 42):
        generic.write(root / str(seed), box_room_scene(seed, 24, 6))
    return root / "41", root / "42"


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory, rooms: tuple[Path, Path]) -> Path:
    """A map of `box-room-41` from `evercal learn`; tests do not change it."""
    folder = tmp_path_factory.mktemp("stores") / "cell.evercal"
    assert main(["learn", str(folder), str(rooms[0])]) == 0
    return folder


@pytest.fixture(scope="session")
def hall_store(hall_map: MapContents, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of `hall`; tests do not change it."""
    from evercal.mapping.store import MapStore

    root = tmp_path_factory.mktemp("stores") / "hall.evercal"
    MapStore.create(root).commit(hall_map.scenes[0], {})
    return root


@pytest.fixture(scope="session")
def still_images(hall: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 20 noisy images of a camera that stands still, at the pose of hall.test[3]."""
    import numpy as np

    from evercal.recordings import write_image

    folder = tmp_path_factory.mktemp("still")
    rng = np.random.default_rng(0)
    image = hall.test[3].read_image().astype(float)
    for i in range(20):
        noisy = (image + rng.normal(0, 4, image.shape)).clip(0, 255).astype("u1")
        write_image(folder / f"{i:02d}.png", noisy)
    return folder


@pytest.fixture(scope="session")
def four_images(still_images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first four of `still_images`."""
    folder = tmp_path_factory.mktemp("four")
    for path in sorted(still_images.iterdir())[:4]:
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


@pytest.fixture(scope="session")
def network_store(
    tmp_path_factory: pytest.TempPathFactory, rooms: tuple[Path, Path]
) -> Path:
    """A store of a network with 5 centres that was trained for four steps on `box-room-41`."""
    from evercal.continual.learning.presets import PRESETS

    demo = PRESETS["demo"]
    folder = tmp_path_factory.mktemp("stores") / "network.evercal"
    words = [
        "learn",
        str(folder),
        str(rooms[0]),
        "--strategy",
        "finetune",
        "--centres",
        "5",
    ]
    with pytest.MonkeyPatch.context() as patch:
        small = replace(
            demo,
            head=replace(demo.head, width=32),
            fit=replace(demo.fit, iterations=4, batch=64, replay_batch=32),
            encode=replace(demo.encode, views_per_frame=1),
        )
        patch.setitem(PRESETS, "demo", small)
        assert main([*words, "--preset", "demo", "--seed", "1"]) == 0
    return folder
