"""What the samples of the camera on the gripper cover, and where to go next."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from evercal.calibration.next_views import NextViews, looked_at, next_views
from evercal.geometry import SE3
from evercal.live.coverage import Coverage, Sample, coverage
from evercal.recordings.frame import Frame

_CANDIDATES = 200
_TURN_RAD, _ROLL_RAD, _NEARER = np.deg2rad(30.0), np.deg2rad(40.0), 0.25
"""How far proposed views may lie from recorded ones where reachable poses are unknown."""

_measured = cache(Sample.of)


def covered(frames: Sequence[Frame], gripper_from_camera: SE3 | None) -> Coverage:
    """What frames cover, for a mount that is known roughly or not at all."""
    return coverage([_measured(frame) for frame in frames], gripper_from_camera)


def next_view(
    frames: Sequence[Frame],
    gripper_from_camera: SE3 | None,
    reachable: SE3 | None,
    refused: Sequence[SE3],
) -> NextViews | None:
    """The view that would lower the uncertainty most; None before the first good frame.

    It is one of the reachable poses, else one near those of the frames.
    """
    rows = covered(frames, gripper_from_camera).samples
    poses = [_measured(frame).base_from_gripper for frame in frames]
    good = [pose for pose, row in zip(poses, rows, strict=True) if not row.problems]
    if not good:
        return None
    if reachable is None:
        reachable = _around(SE3.stack(poses), SE3.stack(good), gripper_from_camera)
    excluded = SE3.stack([*poses, *refused])
    views = next_views(SE3.stack(good), reachable, 1, gripper_from_camera, excluded)
    return views if len(views.poses) else None


def _around(recorded: SE3, good: SE3, gripper_from_camera: SE3 | None) -> SE3:
    """Poses (n,) near recorded ones that look at the same point."""
    mount = SE3.identity() if gripper_from_camera is None else gripper_from_camera
    point_m = looked_at(good @ mount)
    rng, cameras = np.random.default_rng(len(recorded)), recorded @ mount
    start = cameras[rng.integers(len(cameras), size=_CANDIDATES)]
    turns, closer = np.zeros((2, _CANDIDATES, 6))
    turns[:, 3:] = rng.uniform(-_TURN_RAD, _TURN_RAD, (_CANDIDATES, 3))
    distance = np.linalg.norm(start.translation_m - point_m, axis=1)
    closer[:, 2] = distance * rng.uniform(-_NEARER, _NEARER, _CANDIDATES)
    closer[:, 5] = rng.uniform(-_ROLL_RAD, _ROLL_RAD, _CANDIDATES)
    there, back = SE3.from_translation(point_m), SE3.from_translation(-point_m)
    return there @ SE3.exp(turns) @ back @ start @ SE3.exp(closer) @ mount.inverse()
