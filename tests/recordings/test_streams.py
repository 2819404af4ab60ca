"""Frames of folders, videos and sources that do not exist."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.recordings.images import write_image
from evercal.recordings.streams import stream

from .checks import refused


def image(value: int) -> np.ndarray:
    picture = np.full((48, 64, 3), value, np.uint8)
    picture[:, :32] = (200, 30, 10)
    return picture


def test_a_folder_in_natural_order_with_times_of_its_names(tmp_path: Path) -> None:
    for i in (10, 9, 2):
        write_image(tmp_path / f"image-{i}.png", image(i))
    frames = list(stream(str(tmp_path), rate=10))
    names = [frame.name for frame in frames]
    assert names == ["image-2.png", "image-9.png", "image-10.png"]
    assert [frame.stamp_s for frame in frames] == pytest.approx([0, 0.1, 0.2])
    assert frames[1].image[0, 40].tolist() == [9, 9, 9]


def test_a_video_with_its_own_times(tmp_path: Path) -> None:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, (64, 48))
    for i in range(6):
        writer.write(image(40 * i)[..., ::-1])
    writer.release()
    frames = list(stream(str(path)))
    assert [frame.stamp_s for frame in frames] == pytest.approx(
        np.arange(6) / 20, abs=1e-3
    )
    assert frames[4].image[20, 50] == pytest.approx([160] * 3, abs=6)
    assert frames[4].image[20, 10] == pytest.approx([200, 30, 10], abs=12)  # RGB


def test_sources_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "notes.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    for source, message in (
        ("missing", "no such folder or video; give one, a camera's number"),
        ("97", "97: cannot be opened as a video"),
        (tmp_path / "notes.mp4", "cannot be opened as a video"),
        (tmp_path / "empty", "no images in this folder"),
    ):
        refused(message, lambda source: list(stream(str(source))), source)
