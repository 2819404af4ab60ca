"""Scenes at the estimated poses: rendered if possible, else drawn as points."""

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
from evercal.localization.learned import LearnedLocalizer
from evercal.recordings import Frame, Recording
from evercal.reports.page import Picture
from evercal.simulation import untextured

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
POSE = SE3(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.0, -1.0]))


class FixedLocalizer:
    """Localizes every image in one scene, whose only point lies on the optical axis."""

    contents = type("", (), {"short_side": 48})

    def __init__(self, scene: str | None) -> None:
        self.scene = scene

    def camera_for(self, stated: Camera) -> Camera | None:
        return stated

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        return PoseEstimate(
            "failed" if self.scene is None else "ok",
            "",
            self.scene,
            None if self.scene is None else POSE,
            None,
            1,
            1.0,
            0.0,
            np.array([[31.0, 23.0]]),
            np.array([[0.0, 0.0, 1.0]]),
        )


def save_views(out: Path, **scenes_by_strategy: str | None) -> None:
    """Store the views of every strategy, with the scene that it estimates."""
    image = np.full((48, 64, 3), 90, np.uint8)
    frame = Frame("seen", image, CAMERA, POSE)
    scenes = [Recording(name, (frame,), (frame,)) for name in ("hall", "attic")]
    for strategy, scene in scenes_by_strategy.items():
        keep_views(out, strategy, cast("LearnedLocalizer", FixedLocalizer(scene)), scenes)


def grey(picture: Picture) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image.astype(int)


def test_points_are_drawn_for_scenes_without_a_model(tmp_path: Path) -> None:
    save_views(tmp_path, ours="hall", lost=None)
    pictures = view_pictures(tmp_path, ["ours", "lost", "never run"], {})
    assert list(pictures) == ["attic", "hall"]
    query, ours, lost = pictures["hall"]
    assert query.caption == "hall, seen"
    assert (ours.caption.split(":")[0], lost.caption.split(":")[0]) == ("ours", "lost")
    assert abs(grey(query)[24, 32] - 90) < 5
    assert abs(grey(ours)[23, 31] - 90) < 25  # the point, as grey as in the image
    assert grey(ours)[5, 5] > 250
    assert grey(lost).min() > 240


def test_rooms_are_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []

    def render(model: tuple[str, int], frames: list[Frame], poses: list[SE3]) -> list[np.ndarray]:
        calls.append((model, len(frames)))
        return [np.full((48, 64, 3), 200, np.uint8) for _ in frames]

    monkeypatch.setattr(untextured, "untextured_renders", render)
    save_views(tmp_path, ours="hall", lost=None)
    for _ in range(2):
        pictures = view_pictures(tmp_path, ["ours", "lost"], {"hall": ("bedroom", 3)})
        # Both images were localized in the hall; one renderer serves both.
        assert calls == [(("bedroom", 3), 2)]
        assert abs(grey(pictures["hall"][1])[24, 32] - 200) < 5


def test_points_are_drawn_without_the_simulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(untextured, "untextured_renders", lambda *_: [])
    save_views(tmp_path, ours="hall")
    pictures = view_pictures(tmp_path, ["ours"], {"hall": ("bedroom", 3)})
    assert abs(grey(pictures["hall"][1])[23, 31] - 90) < 25
    assert not list(tmp_path.rglob("*.png"))


def test_no_views_give_no_pictures(tmp_path: Path) -> None:
    assert view_pictures(tmp_path, ["ours"], {}) == {}
