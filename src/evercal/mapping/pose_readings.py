"""Other readings of stated poses: inverse, mirrored, of another frame of the recording.

A wrong reading contradicts the images in most pairs, the right one in hardly any. So they are
compared only where a third of the pairs contradict the poses as they are stated.
"""

from collections.abc import Iterator
from copy import copy

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.mapping.pose_check import (
    MatchedPair,
    PoseCheck,
    contradicting,
    depth_scale,
)
from evercal.mapping.prepared_frames import PreparedFrames

MOST_CONTRADICTING = 1 / 3
"""Share of contradicting pairs above which other readings are tried; of right poses 0.10 at most
(real rooms), of those two frames late 0.55."""
BETTER = 3.0
"""Factor by which the share of another reading must be smaller to be named."""
MOST_LATE = 8
"""Poses are compared with those of so many frames before and after."""
MOST_WRONG = 0.25
"""Share of wrong poses. With more, a frame whose pose is right has a majority of wrong ones among
its five partners in more than a tenth of the cases."""
MIN_PAIRS = 20
"""Pairs below which there is no verdict."""
_GL = SE3(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))


def require_consistent(
    recording: PreparedFrames, pairs: list[MatchedPair], check: PoseCheck
) -> None:
    """Refuse a recording whose poses the images contradict.

    Raises:
        InputError: The reading that the images fit, or what else is known about the cause.
    """
    if len(pairs) >= MIN_PAIRS and check.share > MOST_CONTRADICTING:
        reading, share = _best_reading(recording, pairs)
        if share < check.share / BETTER:
            raise InputError(
                f"the stated camera poses contradict the images in {100 * check.share:.0f} % of"
                f" {len(pairs)} pairs, and in {100 * share:.0f} % if they are {reading}; correct"
                " the poses"
            )
    count = len(recording)
    # Poses at one point are refused for their parallax.
    moves = np.ptp(recording.stated.translation_m, axis=0).any()
    if moves and len(check.wrong) > MOST_WRONG * count:
        from evercal.recordings.poses.pose_evidence import rotation_warnings

        causes = rotation_warnings(recording.frames, recording.stated, of_camera=True)
        causes = causes or ["do poses and images belong together?"]
        raise InputError(
            f"{len(check.wrong)} of {count} stated camera poses contradict the images; {causes[0]}"
        )


def _best_reading(
    recording: PreparedFrames, pairs: list[MatchedPair]
) -> tuple[str, float]:
    """The reading with the smallest share of contradicting pairs."""
    shares: dict[str, float] = {}
    for reading, poses in _readings(recording.stated):
        other = copy(recording)
        other.adjust(poses, None)
        other.depth_scale = depth_scale(other, pairs)
        shares[reading] = float(contradicting(other, pairs).mean())
    best = min(shares, key=shares.__getitem__)
    return best, shares[best]


def _readings(stated: SE3) -> Iterator[tuple[str, SE3]]:
    quaternions = stated.rotation_wxyz
    positions = stated.translation_m
    yield "camera_from_base, the inverse", stated.inverse()
    yield "with OpenGL's camera axes (right, up, backward)", stated @ _GL
    for step, order in ((-1, "w, x, y, z"), (1, "x, y, z, w")):
        reordered = SE3(np.roll(quaternions, step, axis=1), positions)
        yield f"with quaternions in the order {order}", reordered
    for axis, name in enumerate("xyz"):
        signs = np.ones(3)
        signs[axis] = -1
        mirrored = SE3(quaternions * [1, *-signs], positions * signs)
        yield f"left-handed with {name} mirrored, or the images are mirrored", mirrored
    rows = np.arange(len(stated))
    for step in range(-MOST_LATE, MOST_LATE + 1):
        shifted = stated[np.clip(rows + step, 0, rows[-1])]
        yield f"those of image i{step:+} for image i (clocks that differ)", shifted
