"""What `benchmarks crowd` writes, and in which order it measures."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import crowd, peak_memory
from benchmarks.publish import publish
from evercal.continual.benchmark.published import read_published
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.localization.localizer import LocalizeOptions
from evercal.recordings import Frame, Recording
from evercal.simulation.box_room import default_camera

CAMERA = default_camera(16, 12)
IMAGE = np.zeros((12, 16, 3), np.uint8)
FRAMES = tuple(Frame(str(i), IMAGE, CAMERA, SE3.identity()) for i in range(4))
UNPOSED = Frame("4", IMAGE, CAMERA, None)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A store with one room whose last frame is placed in the crowd; what was called, in order."""
    done: list[str] = []

    class Fake:
        scenes = ("room", "crowd-5000")
        options = LocalizeOptions()
        maps = SimpleNamespace(scenes=scenes, device=torch.device("cpu"))
        _bank = SimpleNamespace(retrieve=lambda *_: done.append("retrieve"))

        def __init__(self, _: object) -> None:
            pass

        @classmethod
        def open(cls, store: Path) -> "Fake":
            return cls(store)

        def localize(self, image: np.ndarray, camera: object) -> SimpleNamespace:
            done.append("localize")
            scene = self.scenes[len(done) == len(FRAMES)]
            return SimpleNamespace(base_from_camera=SE3.identity(), scene=scene)

        def _prepare(self, image: np.ndarray, camera: object) -> np.ndarray:
            return image

        def _encode(self, views: list[np.ndarray]) -> list[torch.Tensor]:
            return [torch.zeros(2, 1, 1)]

    matcher = SimpleNamespace(candidates=lambda *_: [SimpleNamespace(scene=0)])
    monkeypatch.setattr(crowd, "Localizer", Fake)
    monkeypatch.setattr(crowd, "Matcher", lambda *_: matcher)
    monkeypatch.setattr(crowd, "Query", lambda *_: None)
    monkeypatch.setattr(crowd, "add_room", lambda *_: None)
    scene = Recording("room", FRAMES, (*FRAMES, UNPOSED))
    monkeypatch.setattr(crowd, "load_recording", lambda path, name: scene)
    return done


def test_the_crowd_writes_a_row_that_can_be_published(tmp_path: Path, calls: list[str]) -> None:
    out = tmp_path / "runs" / "crowd.json"
    crowd.run(tmp_path, [Path("room")], 1005, 10, out)
    (row,) = read_published(publish(out, "crowd", {}, out=tmp_path)).rows
    told = [row[key] for key in ("keyframes", "rooms", "frames", "tried", "1 cm/1 deg")]
    assert told == [1000, 10, 4, 100.0, 75.0]
    assert (row["wrong_scene"], row["refused"]) == (1, 0)
    assert json.loads(out.read_text())["settings"]["localize"]
    with pytest.raises(InputError, match="exists"):
        crowd.run(tmp_path, [Path("room")], 1005, 10, out)


def test_times_are_taken_before_anything_else_loads_keyframes(
    tmp_path: Path, calls: list[str]
) -> None:
    crowd.run(tmp_path, [Path("room")], 10, 1, tmp_path / "crowd.json")
    assert calls == ["localize"] * 4 + ["retrieve"] * 4


def test_a_scene_that_the_store_does_not_know_is_named(
    tmp_path: Path, calls: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        crowd, "load_recording", lambda path, name: Recording("attic", FRAMES, FRAMES)
    )
    with pytest.raises(InputError, match="'attic' is not in the store"):
        crowd.run(tmp_path, [Path("attic")], 10, 1, tmp_path / "crowd.json")


@pytest.mark.parametrize("rooms", [0, 11])
def test_every_room_of_the_crowd_has_a_keyframe(
    rooms: int, tmp_path: Path, calls: list[str]
) -> None:
    with pytest.raises(InputError, match=f"--rooms {rooms}: give 1 to 10"):
        crowd.run(tmp_path, [Path("room")], 10, rooms, tmp_path / "crowd.json")
    assert not calls


@pytest.mark.parametrize(("platform", "unit"), [("linux", 1024), ("darwin", 1)])
def test_peak_memory_is_told_in_bytes_of_the_platform(
    platform: str, unit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = SimpleNamespace(ru_maxrss=2_000_000)
    monkeypatch.setattr(peak_memory.sys, "platform", platform)
    monkeypatch.setattr(peak_memory.resource, "getrusage", lambda _: used)
    assert peak_memory.peak_gb(torch.device("cpu")) == pytest.approx(2e-3 * unit)
