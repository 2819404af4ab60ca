"""Structure from motion of plain images and videos."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.recordings import load_recording, stated_poses
from evercal.recordings.images import write_image
from evercal.recordings.reconstruct import _moving, reconstruct
from evercal.recordings.samples import sample_rooms
from evercal.recordings.streams import StreamFrame
from evercal.typing import Array

from .checks import refused

pytest.importorskip("pycolmap")


def frame(number: int, shift_px: int, blur: float = 0) -> StreamFrame:
    """A part of a wide random picture."""
    noise = np.random.default_rng(0).integers(0, 255, (60, 200)).astype(np.uint8)
    wide = cv2.resize(noise, (1600, 480), interpolation=cv2.INTER_CUBIC)
    if blur:
        wide = cv2.GaussianBlur(wide, (0, 0), blur)
    part = np.asarray(wide[:, shift_px : shift_px + 640], np.uint8)
    return StreamFrame(str(number), number / 30, np.repeat(part[..., None], 3, 2))


def test_frames_of_a_standing_camera_are_left_out() -> None:
    shifts = [*[0] * 5, *range(0, 400, 10), *[390] * 5]
    black = frame(0, 0)._replace(name="black", image=np.zeros((480, 640, 3), np.uint8))
    frames = [black, *(frame(i, shift) for i, shift in enumerate(shifts))]
    chosen = [*_moving(iter(frames), 0.05)]
    assert chosen[0].name == "0"
    steps = np.diff([shifts[int(f.name)] for f in chosen])
    assert steps.min() > 0.05 * 640 - 1
    assert steps.max() <= 1.5 * 0.05 * 640 + 10


def test_the_sharpest_frame_of_a_step_is_chosen() -> None:
    frames = [frame(0, 0)]
    for i in range(1, 9):
        frames.append(frame(i, 30 + 2 * i, 0.1 if i == 4 else 3.0))
    chosen = [f.name for f in _moving(iter(frames), 0.05)]
    assert chosen[:2] == ["0", "4"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images without poses."""
    root = tmp_path_factory.mktemp("plain")
    for item in sample_rooms()[0].scene.train[:20]:
        write_image(root / f"{item.name}.png", item.read_image())
    return root


def apart(a: Array, b: Array) -> Array:
    """Distances of points (n, 3) after the best similarity (Umeyama 1991)."""
    a = a - a.mean(0)
    b = b - b.mean(0)
    u, s, v = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ v))])
    scale = (s * np.diag(sign)).sum() / (a**2).sum()
    return np.linalg.norm(b - scale * a @ (u @ sign @ v).T, axis=1)


def test_poses_agree_with_the_truth_up_to_a_similarity(
    folder: Path, tmp_path: Path
) -> None:
    steps = set()
    found = reconstruct(
        folder, tmp_path / "out", on_step=lambda name, *_: steps.add(name)
    )
    assert found.posed >= 18
    assert steps == {"choosing frames", "detecting features", "matching", "mapping"}
    recording = load_recording(tmp_path / "out")
    assert not recording.metric
    names = [Path(frame.name).stem for frame in recording.train]
    room = sample_rooms()[0].scene
    true = stated_poses(frame for frame in room.train if frame.name in names)
    own = stated_poses(sorted(recording.train, key=lambda frame: frame.name))
    assert np.median(apart(own.translation_m, true.translation_m)) < 0.02
    focal = room.train[0].camera.fx
    assert recording.train[0].camera.fx == pytest.approx(focal, rel=0.05)
    refused("is not empty; give a new folder", reconstruct, folder, tmp_path / "out")


def test_sources_that_cannot_be_reconstructed(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 120, 160, 3), np.uint8)
    for i, image in enumerate(noise):
        write_image(tmp_path / f"{i}.png", image)
        if i == 4:
            message = "5 frames to reconstruct, at least 12 are required"
            refused(message, reconstruct, tmp_path, tmp_path / "few")
    refused("do not connect to a model", reconstruct, tmp_path, tmp_path / "noise")
