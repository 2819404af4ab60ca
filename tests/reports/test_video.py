"""Videos of located images: one frame for each image, whole files or none."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.reports.answers import Answer
from evercal.reports.video import FRAMES_A_SECOND, animate, require_ending, write_video

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
GREY = np.full((120, 160, 3), 90, np.uint8)
ORANGE = np.array([213, 94, 0])


def localizer() -> Any:
    keyframes: Any = SimpleNamespace(landmarks=(), cameras=())
    scene = SceneMap("room", CAMERA, CAMERA, keyframes, MapFrame(), 10)
    return SimpleNamespace(contents=SimpleNamespace(scenes=[scene], short_side=120))


def answer(x: float, unit_known: bool = True) -> Answer:
    """An image of a camera at (x, 0, 1) with three landmarks."""
    pose = SE3.exp([x, 0.0, 1.0, 0.0, 0.0, 0.0])
    points = np.array([[0.1, 0.1, 1.0], [0.2, -0.1, 1.0], [-0.2, 0.1, 2.0]])
    pixels = CAMERA.project(points) + 0.5
    values: Any = (1e-6 * np.eye(6), 3, 1.0, 1.0, pixels, pose.apply(points), CAMERA)
    return Answer(
        Path("a.png"), PoseEstimate("ok", "", "room", pose, *values), 1.0, unit_known
    )


REFUSED = Answer(
    Path("b.png"), PoseEstimate("failed", "$dark", None, None, None, 0, 0.0, 1.0), 1.0
)


def orange(frame: np.ndarray) -> int:
    """Pixels of the path in the right half of a frame."""
    return int((np.abs(frame[:, 660:].astype(int) - ORANGE).max(2) < 10).sum())


def test_each_image_is_a_frame_and_the_camera_moves() -> None:
    answers = [REFUSED, answer(0.0), answer(0.3, unit_known=False), REFUSED]
    frames = list(animate(answers, localizer(), lambda path: GREY))
    assert [frame.shape for frame in frames] == [(560, 1280, 3)] * 4
    before, first, second, after = map(orange, frames)
    assert before == 0 < first < second
    assert 0 < after < second  # the path stays, the camera goes


def test_images_without_any_pose_are_shown() -> None:
    [frame] = animate([REFUSED], localizer(), lambda path: GREY)
    assert (frame[200:300, 100:500] == 90).all()


def test_video_holds_the_frames(tmp_path: Path) -> None:
    shades = (40, 120, 200)
    write_video(
        tmp_path / "a.mp4", iter([np.full((64, 96, 3), s, np.uint8) for s in shades])
    )
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == FRAMES_A_SECOND
    images = [image for ok, image in (video.read() for _ in range(4)) if ok]
    assert images[0].shape == (64, 96, 3)
    assert [image.mean() for image in images] == pytest.approx(shades, abs=4)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_interrupted_video_leaves_the_old_file(tmp_path: Path) -> None:
    def frames() -> Iterator[np.ndarray]:
        yield np.zeros((64, 96, 3), np.uint8)
        raise KeyboardInterrupt

    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", frames())
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"old"


def test_a_video_that_lacks_frames_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV says nothing of a full disk."""

    class Silent:
        def __init__(self, *_: object) -> None:
            pass

        def isOpened(self) -> bool:
            return True

        def write(self, _: object) -> None:
            pass

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoWriter", Silent)
    Silent.fourcc = lambda *_: 0  # type: ignore[attr-defined]
    frames = iter([np.zeros((64, 96, 3), np.uint8)] * 3)
    with pytest.raises(InputError, match=r"a.mp4: cannot be written; is the disk full"):
        write_video(tmp_path / "a.mp4", frames)
    assert not list(tmp_path.iterdir())


def test_other_endings_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"a\.avi: not a video format.*help: end it with \.mp4"
    ):
        require_ending(Path("a.avi"))
