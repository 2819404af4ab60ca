"""Gripper poses that stay the same while what the camera sees changes: they were read once."""

from collections.abc import Callable, Sequence

import numpy as np

from evercal.geometry import SE3, spread
from evercal.recordings.frame import Frame, stated_grippers
from evercal.recordings.pictures import changes
from evercal.typing import IntArray

_SAME = 1e-4
"""Largest difference of the numbers of one pose."""
_LEAST = 3
"""Minimum number of rows with one pose."""
_SHARE = 0.2
"""Share of the rows with one pose above which they are stale, not outliers."""
_SEEN = 6
"""Maximum number of images that are compared."""
_CHANGED = 6.0
"""Change from image to image when the camera moves, grey values; recordings have 8 or more."""


def stale_poses(
    poses: SE3, names: Sequence[str], moved: Callable[[IntArray], bool]
) -> str:
    """Describe rows of (n,) poses that are the same while the camera `moved`; empty for none."""
    numbers = np.concatenate([poses.translation_m, poses.rotation_wxyz], 1)
    _, kind = np.unique((numbers / _SAME).round(), axis=0, return_inverse=True)
    counts = np.bincount(kind)
    for group in np.argsort(-counts, kind="stable"):
        if counts[group] < max(_LEAST, _SHARE * len(poses)):
            break
        rows = np.flatnonzero(kind == group)
        if moved(rows):
            where = f"{len(rows)} rows, {names[rows[0]]} to {names[rows[-1]]},"
            if len(rows) == len(poses):
                where = "every row"
            return f"the robot's pose is the same in {where}"
    return ""


def stale_frames(frames: Sequence[Frame]) -> str:
    """Describe frames whose gripper pose is the same while their images change."""

    def moved(rows: IntArray) -> bool:
        chosen = rows[spread(len(rows), _SEEN)]
        seen = changes([frames[i] for i in chosen])
        return bool(np.median(seen) > _CHANGED)

    names = [frame.name for frame in frames]
    sentence = stale_poses(stated_grippers(frames), names, moved)
    if not sentence:
        return ""
    return (
        f"{sentence} while the images change; the robot poses are stale: read them at the time of"
        " each image"
    )
