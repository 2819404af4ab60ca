"""Robot poses that stay the same while the camera moves."""

from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.pose_pairs.checks import require_observable
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame
from evercal.recordings.images import write_image
from evercal.recordings.stale_poses import stale_frames
from evercal.typing import IntArray

ROWS = np.arange(20)
STALE = {
    "every row": (0 * ROWS, "in every row while"),
    "two readings": (ROWS // 10, "in 10 rows, row 1 to row 10, while"),
    "three readings": (ROWS % 3, "in 7 rows, row 1 to row 19, while"),
    "the first twelve": (np.maximum(ROWS, 11), "in 12 rows, row 1 to row 12, while"),
    "the last five": (np.minimum(ROWS, 15), "in 5 rows, row 16 to row 20, while"),
}
"""The reading of each row, and what is said."""


def poses(seed: int) -> SE3:
    return SE3.exp(np.random.default_rng(seed).normal(0, 0.3, (20, 6)))


def pairs(readings: IntArray, camera: SE3) -> PosePairs:
    names = tuple(f"row {i + 1}" for i in ROWS)
    return PosePairs(names, poses(0)[readings], camera)


@pytest.mark.parametrize("case", sorted(STALE))
def test_stale_rows_are_named(case: str) -> None:
    readings, message = STALE[case]
    with pytest.raises(InputError, match=f"{message} the board moves .* stale"):
        require_observable(pairs(readings, poses(1)))


def test_detections_repeated_at_a_pose_are_not_stale() -> None:
    """Also if they scatter by a centimetre."""
    rng = np.random.default_rng(2)
    noise = SE3.exp(rng.normal(0, np.repeat([0.01, 0.02], 3), (20, 6)))
    require_observable(pairs(ROWS // 4, poses(1)[ROWS // 4] @ noise))


@pytest.mark.parametrize("moves", [True, False])
def test_frames_with_one_pose_are_stale_if_their_images_change(
    tmp_path: Path, moves: bool
) -> None:
    rng = np.random.default_rng(0)
    frames = []
    for i in range(12):
        image = np.full((48, 64, 3), 120, np.uint8)
        columns = slice(4 * i, 4 * i + 24) if moves else slice(4, 28)
        image[:, columns] = 20 + rng.integers(0, 4)
        write_image(tmp_path / f"{i}.png", image)
        camera = Camera(64, 48, 60, 60, 31.5, 23.5)
        pose = poses(0)[min(i, 7)]
        frames.append(Frame(f"{i}.png", tmp_path / f"{i}.png", camera, None, pose))
    found = stale_frames(frames)
    assert bool(found) == moves
    assert not moves or "in 5 rows, 7.png to 11.png, while the images change" in found
