"""A first `gripper_from_camera` from images and gripper poses; bundle adjustment refines it.

Features of similar frames are matched. An essential matrix gives the rotation of every pair and the
direction of its translation. Let A be the motion of the gripper, (R, d) that of the camera, and
X = gripper_from_camera. A X = X B gives the rotation of X from the axes of rotation (Park and
Martin, IEEE T-RA 1994). The length of B's translation is unknown, so t_X follows from directions:

    p / |p| = R_X d,   p = (R_A - I) t_X + t_A.

Cross products p x R_X d are linear in t_X, but vanish where t_X lets the camera stand still: before
one place, they end there. The estimate can be off by centimetres; bundle adjustment converges from
there.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from evercal.calibration.pose_pairs.checks import require_rotations
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.features.sift import epipolar_pair, sift_features
from evercal.features.views import working_image
from evercal.features.vlad import similar_pairs
from evercal.geometry import SE3
from evercal.mapping.selection import spread_poses
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame

Array = NDArray[np.float64]


FRAMES, PARTNERS = 120, 6
"""Maximum number of frames, and number of most similar frames that each is matched to."""
ANGLE_DEG, ROTATION_DEG, DIRECTION_DEG = 3.0, 5.0, 10.0
"""Largest difference of the rotation angles, the rotations and the directions of a pair."""
LEAST_ROTATION_DEG, LEAST_PAIRS = 5.7, 6
"""Root mean square angle between frames about each of two axes, and pairs that must agree."""
PRIOR_M = 0.2
"""Standard deviation of the position of the camera before any image."""
ENCODED_SIDE = 240
"""Short side of the images that are encoded, pixels."""
LEAST_SHARE = 0.1
"""Share of the pairs that must agree; before a chessboard most match the wrong squares."""


class PairMotion(NamedTuple):
    """Motion of the camera between two frames, from their images."""

    first: int
    second: int
    rotation: Rotation
    """second_camera_from_first_camera."""
    direction: Array
    """(3,) unit vector of its translation."""


@dataclass(frozen=True, eq=False)
class HandEyeStart:
    """A first `gripper_from_camera`."""

    gripper_from_camera: SE3
    pairs: int
    """Pairs of frames that agree with it, of those whose motion was estimated."""
    of_pairs: int


def hand_eye_start(
    frames: Sequence[Frame],
    encoder: Encoder,
    on_progress: OnProgress = lambda *_: None,
) -> HandEyeStart:
    """Estimate `gripper_from_camera` from frames that all have `base_from_gripper`."""
    poses = SE3.stack([f.base_from_gripper for f in frames if f.base_from_gripper is not None])
    require_rotations(poses, LEAST_ROTATION_DEG, LEAST_ROTATION_DEG)
    if len(frames) > FRAMES:
        some = spread_poses(poses, FRAMES)
        frames, poses = [frames[i] for i in some], poses[some]
    motions = _pair_motions(frames, encoder, on_progress)
    return solve_motions(poses, motions)


def solve_motions(base_from_gripper: SE3, motions: Sequence[PairMotion]) -> HandEyeStart:
    """Solve A X = X B for `gripper_from_camera` by motions between pairs of (n,) gripper poses."""
    if len(motions) < LEAST_PAIRS:
        raise InputError(
            f"only {len(motions)} pairs of images show the same place from two sides, at least"
            f" {LEAST_PAIRS} are needed: record more views that overlap, of a place with"
            " texture"
        )
    first, second = np.array([(m.first, m.second) for m in motions]).T
    moved = base_from_gripper[second].inverse() @ base_from_gripper[first]
    gripper_rotation = Rotation.from_quat(moved.rotation_wxyz, scalar_first=True).as_rotvec()
    camera_rotation = np.array([m.rotation.as_rotvec() for m in motions])
    difference = np.linalg.norm(gripper_rotation, axis=1) - np.linalg.norm(camera_rotation, axis=1)
    same_angle = np.abs(difference) < np.deg2rad(ANGLE_DEG)
    _refuse_disagreement(same_angle)
    rotation, distance = _robust_rotation(gripper_rotation[same_angle], camera_rotation[same_angle])
    agree = np.zeros(len(motions), bool)
    limit = 4 * max(1.48 * float(np.median(distance)), 1e-3)
    limit = min(limit, np.deg2rad(ROTATION_DEG))
    agree[np.flatnonzero(same_angle)[distance < limit]] = True
    _refuse_disagreement(agree)
    towards = rotation.apply(np.array([m.direction for m in motions]))
    translation, apart = _robust_translation(moved, towards, agree)
    # The direction of a small sideways motion is noise, so few pairs may be enough.
    agree &= apart < np.deg2rad(DIRECTION_DEG)
    if agree.sum() < LEAST_PAIRS:
        raise InputError(
            f"the directions in which gripper and images moved agree in only {agree.sum()} of"
            f" {len(agree)} pairs of frames: move the camera sideways by 10 cm or more as well as"
            " turning it, and check that the poses are in metres"
        )
    start = SE3(rotation.as_quat(canonical=True, scalar_first=True), translation)
    return HandEyeStart(start, int(agree.sum()), len(motions))


def _refuse_disagreement(agree: NDArray[np.bool_]) -> None:
    if agree.sum() < max(LEAST_PAIRS, LEAST_SHARE * len(agree)):
        raise InputError(
            f"the gripper's motion and the images agree in only {agree.sum()} of {len(agree)} pairs"
            " of frames: check that the poses belong to these images, that they are poses of the"
            " gripper in the base (not the inverse), and the order of their quaternions or angles"
        )


def _robust_rotation(gripper: Array, camera: Array) -> tuple[Rotation, Array]:
    weight = np.ones(len(gripper))
    rotation, distance = Rotation.identity(), weight
    for _ in range(30):
        rotation = Rotation.align_vectors(gripper, camera, weights=weight)[0]
        distance = np.linalg.norm(gripper - rotation.apply(camera), axis=1)
        spread = max(1.48 * float(np.median(distance)), 1e-5)
        weight = 1 / (1 + (distance / spread) ** 2) ** 2
    return rotation, distance


def _robust_translation(
    moved: SE3, towards: Array, agree: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """The translation (3,) and the angles (n,) between observed and predicted directions."""
    rotation = moved.rotation_matrix() - np.eye(3)
    translation, angle = np.zeros(3), np.zeros(len(towards))
    for _ in range(30):
        predicted = rotation @ translation + moved.translation_m
        length = np.maximum(np.linalg.norm(predicted, axis=1), 1e-6)[:, None]
        ahead = predicted / length
        off = ahead - towards
        angle = np.linalg.norm(off, axis=1)
        spread = max(1.48 * float(np.median(angle[agree])), 1e-4)
        weight = agree / (1 + (angle / spread) ** 2) ** 2 / spread**2
        along = np.einsum("ni,nij->nj", ahead, rotation)
        rows = (rotation - ahead[:, :, None] * along[:, None]) / length[..., None]
        information = np.einsum("n,nji,njk->ik", weight, rows, rows) + np.eye(3) / PRIOR_M**2
        slope = np.einsum("n,nji,nj->i", weight, rows, off) + translation / PRIOR_M**2
        translation -= np.linalg.solve(information, slope)
    return translation, angle


def _pair_motions(
    frames: Sequence[Frame], encoder: Encoder, on_progress: OnProgress
) -> list[PairMotion]:
    """Motions of similar frames with enough inliers."""
    images, cameras, features = [], [], []
    for frame in frames:
        image = frame.read_image()
        grey, camera = working_image(image, frame.camera, min(480, *image.shape[:2]))
        images.append(grey)
        cameras.append(camera)
        features.append(encoder.encode(grey, ENCODED_SIDE).reshape(-1, encoder.width))
    pairs = similar_pairs(features, encoder.vlad(features), PARTNERS)
    motions: list[PairMotion] = []
    with ThreadPoolExecutor(cores()) as pool:
        points = list(pool.map(sift_features, images))

        def motion_of(pair: tuple[int, int]) -> PairMotion | None:
            i, j = pair
            found = epipolar_pair(points[i], points[j], cameras[i], cameras[j])
            if found is None:
                return None
            return PairMotion(i, j, found.rotation, found.direction)

        for done, motion in enumerate(pool.map(motion_of, pairs), start=1):
            motions += [motion] if motion is not None else []
            on_progress("matching", done, len(pairs))
    return motions
