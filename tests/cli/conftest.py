"""Two tiny rooms on disk, a store that knows the first, and a way to run commands."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from evercal.cli import main


@dataclass(frozen=True)
class Ran:
    """What a command did."""

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
        lines = [line for line in err.split("\n") if line and not re.search(r"\r|it/s|/s\]", line)]
        return Ran(code, out, lines)

    return call


@pytest.fixture(scope="module", autouse=True)
def tiny() -> Iterator[None]:
    """Training takes a second; thresholds of networks, slow to fit, believe every pose."""
    from evercal.continual.presets import PRESETS
    from evercal.localization import acceptance

    demo = PRESETS["demo"]
    stage = replace(
        demo,
        head=replace(demo.head, width=32),
        fit=replace(demo.fit, iterations=4, batch=64, replay_batch=32),
        encode=replace(demo.encode, views_per_frame=1),
        replay_views_per_frame=1,
    )
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fast", "demo"):
            patch.setitem(PRESETS, name, stage)
        patch.setattr(acceptance, "fit_threshold", lambda *_: (0.0, 1.0))
        yield


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Folders of the scenes `box-room-41` and `box-room-42`, 24 training and 6 test frames each."""
    from evercal.recordings import generic

    from ..box_world import box_room_scene

    root = tmp_path_factory.mktemp("rooms")
    for seed in (41, 42):
        generic.write(root / str(seed), box_room_scene(seed, 24, 6))
    return root / "41", root / "42"


@pytest.fixture(scope="module")
def store(tiny: None, tmp_path_factory: pytest.TempPathFactory, rooms: tuple[Path, Path]) -> Path:
    """A store that knows `box-room-41`; not to be changed."""
    folder = tmp_path_factory.mktemp("stores") / "known"
    assert main(["learn", str(folder), str(rooms[0])]) == 0
    return folder


@pytest.fixture
def snapshot() -> Callable[[Path], dict[str, bytes | None]]:
    """Every file and folder below a folder with its content."""

    def take(folder: Path) -> dict[str, bytes | None]:
        return {
            str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
            for path in sorted(folder.rglob("*"))
        }

    return take
