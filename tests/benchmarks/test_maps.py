"""What `benchmarks maps` writes is what was measured, with the settings that were used."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import maps
from benchmarks.publish import publish
from evercal.continual.benchmark.published import read_published
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.localization.estimate import PoseEstimate
from evercal.recordings import Frame, Recording
from evercal.simulation.box_room import default_camera

CAMERA = default_camera(16, 12)


def frames(count: int) -> tuple[Frame, ...]:
    image = np.zeros((12, 16, 3), np.uint8)
    return tuple(Frame(str(i), image, CAMERA, SE3.identity()) for i in range(count))


class Answers:
    """A localizer that knows one scene and is off by so many metres; None is refused."""

    def __init__(self, metres: list[float | None], sigma_m: float) -> None:
        self.maps = SimpleNamespace(scenes=[SimpleNamespace(camera=CAMERA)], keyframes=[None])
        self.scenes = ["room"]
        self.metres, self.sigma_m = metres, sigma_m
        self.cameras: list[object] = []

    def localize(self, image: np.ndarray, camera: object = None) -> PoseEstimate:
        self.cameras.append(camera)
        off = self.metres.pop(0) if self.metres else None
        if off is None:
            return PoseEstimate("unknown_scene", "", None, None, None, 0, 0.0, 1.0)
        pose = SE3.exp(np.array([off, 0, 0, 0, 0, 0]))
        covariance = self.sigma_m**2 * np.eye(6)
        return PoseEstimate("ok", "", "room", pose, covariance, 9, 0.5, 1.0, support=0.4)


def test_every_pose_in_the_right_scene_counts_for_its_ellipsoid() -> None:
    """Two of five answers are 6 cm and a metre off, and neither was said to be so uncertain."""
    localizer = Answers([0.001, 0.002, 0.003, 0.06, 1.0, None], 0.001)
    row = maps.errors(localizer, frames(6), "room")  # pyright: ignore[reportArgumentType]
    assert row["inside_95"] == 60.0
    assert row["refused"] == 1
    row = maps.errors(Answers([None], 0.001), frames(1), "room")  # pyright: ignore[reportArgumentType]
    assert np.isnan(float(str(row["inside_95"])))


@pytest.mark.parametrize("what", ["fixed", "ablation", "strangers"])
def test_the_share_of_keyframes_is_used_and_written(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = []

    def learn(store: Path, scene: Recording, options: maps.LearnOptions) -> None:
        used.append(options.stage.memory_share)

    scene = Recording("room", frames(3), frames(2))
    monkeypatch.setattr(maps, "learn_scene", learn)
    monkeypatch.setattr(maps, "load_recording", lambda folder: scene)
    monkeypatch.setattr(maps.Localizer, "open", lambda *_: Answers([0.001] * 1000, 0.01))
    maps.run(what, [Path("a"), Path("b")], tmp_path / what, 0.03)
    source = tmp_path / what / f"{what}.json"
    assert set(used) == {0.03}
    assert json.loads(source.read_text())["settings"]["stage"]["memory_share"] == 0.03
    assert read_published(publish(source, what, {}, out=tmp_path)).rows


def test_a_scene_of_a_sequence_counts_its_own_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A report counts those of all scenes of the store."""
    reports = [SimpleNamespace(seconds=1.0, memory_bytes=n) for n in (300, 500, 900)]
    monkeypatch.setattr(maps, "learn_scene", lambda *_: reports.pop(0))
    monkeypatch.setattr(maps.Localizer, "open", lambda *_: Answers([0.001] * 10, 0.01))
    scenes = [Recording(name, frames(3), frames(1)) for name in ("room", "hall", "attic")]
    rows = maps.sequence(scenes, tmp_path, 0.1)
    assert [row["bytes"] for row in rows] == [300, 200, 400, 300]


def test_strangers_without_images_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maps, "load_recording", lambda folder: Recording("a", frames(3), ()))
    with pytest.raises(InputError, match="b: has no test images"):
        maps.run("strangers", [Path("a"), Path("b")], tmp_path / "out", 0.1)


def test_strangers_are_shown_with_the_camera_that_took_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = default_camera(32, 24)
    image = np.zeros((24, 32, 3), np.uint8)
    taken = tuple(Frame(str(i), image, other, SE3.identity()) for i in range(2))
    scenes = {"a": Recording("a", frames(3), ()), "b": Recording("b", frames(3), taken)}
    answers = Answers([0.001], 0.01)
    monkeypatch.setattr(maps, "learn_scene", lambda *_: None)
    monkeypatch.setattr(maps, "load_recording", lambda folder: scenes[folder.name])
    monkeypatch.setattr(maps.Localizer, "open", lambda *_: answers)
    maps.run("strangers", [Path("a"), Path("b")], tmp_path / "out", 0.1)
    rows = json.loads((tmp_path / "out" / "strangers.json").read_text())["rows"]
    assert [(row["images"], row["count"], row["believed"]) for row in rows[:2]] == [
        ("b", 2, 1),
        ("blank", 1, 0),
    ]
    assert answers.cameras[:3] == [other, other, CAMERA]
