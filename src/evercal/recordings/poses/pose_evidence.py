"""What the images say about the stated rotations: inverted poses, other axes, mixed-up angles.

The turn between two images of one scene shows in the images alone (the essential matrix; Nister, An
Efficient Solution to the Five-Point Relative Pose Problem, PAMI 2004). Of poses that are what they
are said to be, a camera's turns equal these, and a gripper's equal them but for one fixed rotation
between gripper and camera. Inverted poses turn about other axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3
from evercal.recordings.frame import Frame

Array = NDArray[np.float64]

PAIRS = 16
"""Pairs of images that are looked at."""
LEAST_PAIRS = 6
"""Fewer pairs with enough matches say nothing."""
TURN_DEG, WANTED_DEG = 5.0, 12.0
"""How far the images of a pair are turned as stated, at least and at best."""
APART = 30
"""The images of a pair are at most so many frames apart."""
LEAST_MATCHES = 40
LONG_SIDE = 640
AGREE_DEG = 2.0
"""Turns that differ by no more agree."""
STILL_DEG = 1.0
BETTER, CLOSE_DEG = 3.0, 0.5
"""Another reading of the poses has to fit so many times better to be named; with it those that fit
as well within so much."""
GRIPPER_AGREE_DEG, GRIPPER_BETTER = 1.0, 2.0
"""The same of a gripper, which has a free rotation to fit with: only far turns tell readings
apart."""
# A camera's axes (right, down, forward) in OpenGL's (right, up, backward).
_GL = Rotation.from_euler("x", 180, degrees=True)


@dataclass(frozen=True, eq=False)
class Turns:
    """How far the second image of each pair is turned against the first, as rotation vectors."""

    seen: Array
    """(n, 3) radians, by the images, in the first camera."""
    stated: Array
    """(n, 3) by the poses, in the first frame."""
    inverse: Array
    """(n, 3) by the inverses of the poses."""
    swapped: Array
    """(n, 3) by the poses whose quaternions are read in the other order."""


def doubts(frames: Sequence[Frame], poses: SE3, of_camera: bool) -> list[str]:
    """Sentences about how stated poses contradict the images; none where they agree.

    Args:
        frames: in recorded order.
        poses: (n,) base_from_camera or base_from_gripper of them.
        of_camera: which of the two.

    Raises:
        InputError: an image that cannot be read.
    """
    turns = measure(frames, poses)
    if turns is None:
        return []
    return _camera_doubts(turns) if of_camera else _gripper_doubts(turns)


def measure(frames: Sequence[Frame], poses: SE3) -> Turns | None:
    """The turns between some pairs of images; None where too few could be matched."""
    pairs, seen = [], []
    for first, second in _pairs(poses):
        turn = seen_turn(frames[first], frames[second])
        if turn is not None:
            pairs.append((first, second))
            seen.append(turn)
    if len(pairs) < LEAST_PAIRS:
        return None
    first, second = np.array(pairs).T
    stated = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)
    swapped = Rotation.from_quat(poses.rotation_wxyz)  # as if w stood last
    return Turns(
        np.array(seen),
        (stated[first].inv() * stated[second]).as_rotvec(),
        (stated[first] * stated[second].inv()).as_rotvec(),
        (swapped[first].inv() * swapped[second]).as_rotvec(),
    )


def seen_turn(first: Frame, second: Frame) -> Array | None:
    """(3,) rotation vector first_from_second of two images, radians; None with too few matches."""
    import cv2

    found = [_features(frame) for frame in (first, second)]
    if min(len(rays) for rays, _ in found) < LEAST_MATCHES:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    near = matcher.knnMatch(found[0][1], found[1][1], k=2)
    kept = [m[0] for m in near if len(m) == 2 and m[0].distance < 0.75 * m[1].distance]
    if len(kept) < LEAST_MATCHES:
        return None
    a = found[0][0][[m.queryIdx for m in kept]]
    b = found[1][0][[m.trainIdx for m in kept]]
    pixel = 1.5 / (first.camera.fx * min(1.0, LONG_SIDE / max(first.camera.width, 1)))
    cv2.setRNGSeed(0)
    matrix, inside = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, pixel)
    if matrix is None or matrix.shape != (3, 3) or int(inside.sum()) < LEAST_MATCHES:
        return None
    _, second_from_first, _, _ = cv2.recoverPose(matrix, a, b, np.eye(3), mask=inside)
    return Rotation.from_matrix(second_from_first).inv().as_rotvec()


def _features(frame: Frame) -> tuple[Array, NDArray[np.float32]]:
    """(n, 2) points of the plane at distance one, and their SIFT descriptors."""
    import cv2

    image = cv2.cvtColor(frame.read_image(), cv2.COLOR_RGB2GRAY)
    camera = frame.camera
    scale = LONG_SIDE / max(camera.width, camera.height)
    if scale < 1:
        camera = camera.resized(round(camera.width * scale), round(camera.height * scale))
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT_create(1500)  # pyright: ignore[reportAttributeAccessIssue]
    points, descriptors = sift.detectAndCompute(image, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    rays = camera.unproject([point.pt for point in points])[:, :2]
    known = np.isfinite(rays).all(1)
    return rays[known], descriptors[known]


def _pairs(poses: SE3) -> list[tuple[int, int]]:
    """Frames spread over the recording, each with a later one that is turned enough.

    Far turns tell most, but where stated angles are nonsense only near frames are sure to match:
    every second pair is the nearest one.
    """
    rotation = Rotation.from_quat(poses.rotation_wxyz, scalar_first=True)
    found = []
    firsts = np.unique(np.linspace(0, len(poses) - 2, PAIRS).round().astype(int))
    for i, first in enumerate(firsts):
        later = np.arange(first + 1, min(first + 1 + APART, len(poses)))
        turned = np.rad2deg((rotation[first].inv() * rotation[later]).magnitude())
        best = np.argmin(np.abs(turned - WANTED_DEG)) if i % 2 else np.argmax(turned > TURN_DEG)
        if turned[best] > TURN_DEG:
            found.append((int(first), int(later[best])))
    return found


def _camera_doubts(turns: Turns) -> list[str]:
    as_said = _apart(turns.seen, turns.stated)
    if as_said < AGREE_DEG:
        return []
    fits = {
        "camera_from_base, the inverse": _apart(turns.seen, turns.inverse),
        "with OpenGL's camera axes (right, up, backward)": _apart(
            turns.seen, _GL.apply(turns.stated)
        ),
        "the inverse with OpenGL's camera axes": _apart(turns.seen, _GL.apply(turns.inverse)),
        "with quaternions in another order": _apart(turns.seen, turns.swapped),
    }
    if min(fits.values()) > as_said / BETTER:
        fits["those of another frame, at a fixed angle to the camera"] = _fitted(
            turns.seen, turns.stated
        )
    return [_told("camera", as_said, fits, len(turns.seen), BETTER)]


def _gripper_doubts(turns: Turns) -> list[str]:
    if _still(turns):
        return [
            "the gripper turns and the images hardly do; does the camera stand still, or are the"
            " angles in another unit than was said?"
        ]
    as_said = _fitted(turns.seen, turns.stated)
    fits = {
        "gripper_from_base, the inverse": _fitted(turns.seen, turns.inverse),
        "with quaternions in another order": _fitted(turns.seen, turns.swapped),
    }
    better = min(fits.values()) < as_said / GRIPPER_BETTER
    if as_said < (GRIPPER_AGREE_DEG if better else AGREE_DEG):
        return []
    return [_told("gripper", as_said, fits, len(turns.seen), GRIPPER_BETTER)]


def _still(turns: Turns) -> bool:
    """Whether the images hardly turn although the gripper does."""
    return float(np.rad2deg(np.median(np.linalg.norm(turns.seen, axis=1)))) < STILL_DEG


def _told(what: str, as_said: float, fits: dict[str, float], pairs: int, better: float) -> str:
    least = min(fits.values())
    said = (
        f"the {what} turns otherwise than the images do, by {as_said:.1f} deg in the median of"
        f" {pairs} pairs"
    )
    if least < min(AGREE_DEG, as_said / better):
        alike = [guess for guess, fit in fits.items() if fit < least + CLOSE_DEG]
        return f"{said}; the poses fit ({least:.1f} deg) if they are {', or '.join(alike)}"
    return (
        f"{said}; do poses and images go together, are angles in the unit and Euler order that was"
        f" said, and are the intrinsics right?"
    )


def _apart(seen: Array, stated: Array) -> float:
    """Median angle between turns, degrees."""
    off = Rotation.from_rotvec(seen).inv() * Rotation.from_rotvec(stated)
    return float(np.rad2deg(np.median(off.magnitude())))


def _fitted(seen: Array, stated: Array) -> float:
    """The same after the fixed rotation between the two frames that fits best."""
    weights = np.ones(len(seen))
    turn = Rotation.identity()
    for _ in range(5):  # turns that fit badly count less
        turn = Rotation.align_vectors(seen, stated, weights)[0]
        off = np.linalg.norm(turn.apply(stated) - seen, axis=1)
        weights = 1 / (1 + (off / max(float(np.median(off)), 1e-6)) ** 2)
    return _apart(seen, turn.apply(stated))
