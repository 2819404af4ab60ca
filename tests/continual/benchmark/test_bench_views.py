"""What methods see: rendered once where a room can be rendered, else drawn from points."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest

from evercal.continual.benchmark.bench_views import view_pictures
from evercal.continual.benchmark.scene_views import keep_views
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.recordings import Frame, Recording
from evercal.simulation import untextured

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
POSE = SE3(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.0, -1.0]))


class Told:
    """Finds every image in one scene, whose only point lies on the optical axis."""

    maps = type("", (), {"short_side": 48})

    def __init__(self, scene: str | None) -> None:
        self.scene = scene

    def localize(self, image: np.ndarray, camera: Camera) -> PoseEstimate:
        lost = self.scene is None
        return PoseEstimate(
            "failed" if lost else "ok",
            "",
            self.scene,
            None if lost else POSE,
            None,
            1,
            1.0,
            0.0,
            np.array([[31.0, 23.0]]),
            np.array([[0.0, 0.0, 1.0]]),
        )


def made(out: Path, **found: str | None) -> None:
    """The view of a scene `hall` for every strategy, with the scene that it found."""
    image = np.full((48, 64, 3), 90, np.uint8)
    frame = Frame("seen", image, CAMERA, POSE)
    scenes = [Recording(name, (frame,), (frame,)) for name in ("hall", "attic")]
    for strategy, scene in found.items():
        keep_views(out, strategy, cast("Localizer", Told(scene)), scenes)


def sheet(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def test_points_are_drawn_where_nothing_can_be_rendered(tmp_path: Path) -> None:
    made(tmp_path, ours="hall", lost=None)
    pictures = view_pictures(tmp_path, ["ours", "lost", "never run"], {})
    assert [p.caption for p in pictures] == ["attic, seen", "hall, seen"]
    row = sheet(pictures[1].data)[6:186]
    query, ours, lost = (row[:, 6 + 246 * i : 246 + 246 * i] for i in range(3))
    assert abs(int(query[90, 120]) - 90) < 5
    assert abs(int(ours[90, 120]) - 90) < 25  # the point, as grey as it was seen
    assert ours[20, 20] > 250
    assert lost[10:160, 10:230].min() > 240


def test_rooms_are_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def clay(model: tuple[str, int], frames: list[Frame], poses: list[SE3]) -> list[np.ndarray]:
        asked.append((model, len(frames)))
        return [np.full((48, 64, 3), 200, np.uint8) for _ in frames]

    monkeypatch.setattr(untextured, "untextured_renders", clay)
    made(tmp_path, ours="hall", lost=None)
    for _ in range(2):
        pictures = view_pictures(tmp_path, ["ours", "lost"], {"hall": ("bedroom", 3)})
        # Both images were found in the hall; one renderer is enough for them.
        assert asked == [(("bedroom", 3), 2)]
        assert abs(int(sheet(pictures[0].data)[96, 6 + 246 + 120]) - 200) < 5


def test_without_the_simulator_points_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(untextured, "untextured_renders", lambda *_: [])
    made(tmp_path, ours="hall")
    (picture, _) = view_pictures(tmp_path, ["ours"], {"hall": ("bedroom", 3)})
    assert abs(int(sheet(picture.data)[96, 6 + 246 + 120]) - 90) < 25
    assert not list(tmp_path.rglob("*.png"))


def test_nothing_kept_nothing_shown(tmp_path: Path) -> None:
    assert view_pictures(tmp_path, ["ours"], {}) == []
