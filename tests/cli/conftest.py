"""Recordings and maps on disk, and a way to run commands."""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from evercal.cli import main


@dataclass(frozen=True)
class Ran:
    """Outcome of a command."""

    code: int
    out: str
    err: list[str]
    """Lines on stderr apart from progress bars."""

    @property
    def json(self) -> Any:
        """The object on stdout."""
        return json.loads(self.out)


def words_of(words: Iterable[object]) -> list[str]:
    """Words of a command; a string stands for all words in it, other things for one."""
    split = []
    for word in words:
        split += word.split() if isinstance(word, str) else [str(word)]
    return split


@dataclass(frozen=True)
class Run:
    """Runs commands in this process; a string may hold several words."""

    capture: pytest.CaptureFixture[str]

    def __call__(self, *words: object) -> Ran:
        self.capture.readouterr()
        code = main(words_of(words))
        out, err = self.capture.readouterr()
        # A bar rewrites its line after a carriage return and ends it with a line break.
        lines = [
            line
            for line in err.split("\n")
            if line and not re.search(r"\r|it/s|/s\]", line)
        ]
        return Ran(code, out, lines)

    def json(self, *words: object) -> Any:
        """The object that a command prints with --json."""
        return self(*words, "--json").json

    def refused(self, *words: object) -> str:
        """The one line of a command that refuses its input and prints nothing else."""
        ran = self(*words)
        assert (ran.code, ran.out, len(ran.err)) == (2, "", 1), ran
        return ran.err[0]


@pytest.fixture
def run(capfd) -> Run:
    return Run(capfd)


@pytest.fixture(scope="session")
def rooms(tmp_path_factory) -> tuple[Path, Path]:
    """Folders of the scenes `box-room-41` and `box-room-42`, 24 training and 6 test frames each."""
    from evercal.recordings import generic

    from ..box_world import box_room_scene

    root = tmp_path_factory.mktemp("rooms")
    for seed in (41, 42):
        generic.write(root / str(seed), box_room_scene(seed, 24, 6))
    return root / "41", root / "42"


@pytest.fixture(scope="session")
def learned(tmp_path_factory, rooms) -> tuple[Path, str]:
    """A map of `box-room-41` that tests do not change, and what `evercal learn` printed."""
    folder = tmp_path_factory.mktemp("stores") / "cell.evercal"
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(words_of(["learn", folder, rooms[0]])) == 0
    return folder, printed.getvalue()


@pytest.fixture(scope="session")
def store(learned) -> Path:
    """A map of `box-room-41`; tests do not change it."""
    return learned[0]


@pytest.fixture(scope="session")
def hall_store(hall_map, tmp_path_factory) -> Path:
    """A map of `hall`; tests do not change it."""
    from evercal.mapping.store import MapStore

    root = tmp_path_factory.mktemp("stores") / "hall.evercal"
    MapStore.create(root).commit(hall_map.scenes[0], {})
    return root


@pytest.fixture(scope="session")
def still_images(hall, tmp_path_factory) -> Path:
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
def four_images(still_images, tmp_path_factory) -> Path:
    """The first four of `still_images`."""
    folder = tmp_path_factory.mktemp("four")
    for path in sorted(still_images.iterdir())[:4]:
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


@pytest.fixture(scope="session")
def network_store(tmp_path_factory, rooms) -> Path:
    """A store of a network with 5 centres that was trained for four steps on `box-room-41`."""
    from evercal.continual.learning.presets import PRESETS

    demo = PRESETS["demo"]
    folder = tmp_path_factory.mktemp("stores") / "network.evercal"
    options = "--strategy finetune --centres 5 --preset demo --seed 1"
    with pytest.MonkeyPatch.context() as patch:
        small = replace(
            demo,
            head=replace(demo.head, width=32),
            fit=replace(demo.fit, iterations=4, batch=64, replay_batch=32),
            encode=replace(demo.encode, views_per_frame=1),
        )
        patch.setitem(PRESETS, "demo", small)
        assert main(words_of(["learn", folder, rooms[0], options])) == 0
    return folder
