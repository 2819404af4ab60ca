"""A first hand-eye transform from images and gripper poses; bundle adjustment refines it.

Features of similar frames are matched. Let A be the motion of the gripper between two images, and
X the transform from the camera to what it is mounted on. X and the gripper poses predict an
epipolar line for every match. The distances from these lines (Sampson's approximation) are
minimised over all six parameters of X, from rotations all around.

A camera on the gripper moves in the base. A fixed camera moves, as the gripper sees it, around the
thing that the gripper holds, with the inverse poses.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.calibration.pose_pairs.checks import require_rotations
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.features.sift import epipolar_pair, sift_features
from evercal.features.views import working_image
from evercal.features.vlad import similar_pairs
from evercal.geometry import SE3, Camera, cross_matrix
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.selection import spread_poses
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame, stated_grippers
from evercal.robot.arm import Arm
from evercal.robot.arm_offsets import ArmOffsets
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount
from evercal.typing import Array, BoolArray, Float32Array, Image

FRAMES, PARTNERS = 120, 6
"""Maximum number of frames, and number of most similar frames that each is matched to."""
ANGLE_DEG, AGREE_DEG = 3.0, 0.5
"""Scale of the first angles between the rays of matches and their epipolar planes, and largest
median of a pair that agrees."""
LEAST_ROTATION_DEG, LEAST_PAIRS = 5.7, 6
"""Root mean square angle between frames about each of two axes, and pairs that must agree."""
SPREAD_M = {EYE_IN_HAND: 0.2, EYE_TO_HAND: 2.0}
"""Standard deviation of the position of the camera before any image."""
JOINT_SPREAD = np.deg2rad(BundleOptions().joint_sigma_deg)
"""Standard deviation of the offset of a joint, radians or metres."""
DEPTHS_M = (0.3, 0.6, 1.2, 2.4)
"""First distances between a fixed camera and the gripper."""
STILL_PX = 2.0
"""Before a fixed camera, matches that move less stand still."""
BESIDE_M = 0.1
"""First positions of a camera on the gripper: there, and this far along each axis."""
MATCHES = 30
"""Matches of a pair that count, at most."""
ENCODED_SIDE = 240
"""Short side of the images that are encoded, pixels."""
LEAST_SHARE, SURE_SHARE = 0.3, 0.8
"""Share of the pairs that must agree, and share from which no other mount is tried. Before a
chessboard half of the pairs match the wrong squares; of another mount up to 0.3 agree."""
ROTATIONS, FIRST_PAIRS, FIRST_MATCHES = 48, 40, 10
"""First rotations that are tried, on this many pairs and matches of each."""
X_SCALE = np.repeat([0.01, 0.1], 3)
"""Radians and metres by which a pose of a camera changes."""


class ImagePair(NamedTuple):
    """Two images and their matches."""

    first: int
    second: int
    rays: Array
    """(2, n, 3) rays of the matches in both camera frames, at depth 1."""


@dataclass(frozen=True, eq=False)
class HandEyeStart:
    """A first transform from the camera to what it is mounted on."""

    parent_from_camera: SE3
    """gripper_from_camera of eye_in_hand, base_from_camera of eye_to_hand."""
    mount: Mount
    pairs: int
    """Pairs of frames that agree with it, of those with matches."""
    of_pairs: int
    matches: tuple[ImagePair, ...] = ()
    """The pairs that agree."""
    distance_deg: float = 0.0
    """Median angle of matches from their epipolar planes, median of the pairs."""
    arm: ArmOffsets | None = None
    """First offsets of the joints, where joint values are stated."""


class Joints(NamedTuple):
    """Joint values of n frames."""

    arm: Arm
    values: Array
    """(n, k)."""

    def matrices(self, offsets: Array, mount: Mount) -> Array:
        """(n, 4, 4) as `scene_from_parent`, with offsets (k,)."""
        poses = self.arm.poses(self.values + offsets * self.arm.free())
        return mount.scene_from_parent(poses).matrix()


def scene_from_parent(frames: Sequence[Frame], mount: Mount) -> SE3:
    """(n,) poses that move the camera: base_from_gripper, or gripper_from_base of eye_to_hand."""
    return mount.scene_from_parent(stated_grippers(frames))


def hand_eye_start(
    frames: Sequence[Frame],
    mount: Mount,
    encoder: Encoder,
    on_progress: OnProgress = lambda *_: None,
    arm: Arm | None = None,
) -> HandEyeStart:
    """Estimate the transform of a camera from frames that all have `base_from_gripper`.

    If `arm` is given, the frames state its joint values, and their offsets are estimated, too.
    """
    poses = scene_from_parent(frames, mount)
    require_rotations(poses, LEAST_ROTATION_DEG, LEAST_ROTATION_DEG)
    if len(frames) > FRAMES:
        some = spread_poses(poses, FRAMES)
        frames = [frames[i] for i in some]
        poses = poses[some]
    pairs = image_pairs(frames, mount, encoder, on_progress)
    joints = arm and Joints(arm, np.array([frame.joints_rad for frame in frames]))
    try:
        start = start_from_matches(poses, pairs, mount, joints)
    except InputError:
        _refuse_other_mount(poses.inverse(), pairs, mount, None)
        raise
    if start.pairs < SURE_SHARE * start.of_pairs:
        _refuse_other_mount(poses.inverse(), pairs, mount, start)
    return start


def _refuse_other_mount(
    poses: SE3, pairs: Sequence[ImagePair], mount: Mount, start: HandEyeStart | None
) -> None:
    """Refuse a recording whose images fit the inverse poses better."""
    rivals = []
    for other in SPREAD_M:
        with suppress(InputError):
            rivals.append(start_from_matches(poses, pairs, other))
    rival = min(rivals, key=lambda rival: rival.distance_deg, default=None)
    if rival is None or (
        start is not None and rival.distance_deg > start.distance_deg / 2
    ):
        return
    another = "the camera moves with the gripper ('evercal learn MAP RECORDING --calibration FILE')"
    if mount.moves:
        another = "the camera stands still and shows what the gripper holds ('evercal eye-to-hand')"
    raise InputError(
        f"the inverse poses agree with the images in {rival.pairs} of {rival.of_pairs} pairs of"
        f" frames: either the poses are those of the base in the gripper, then invert them, or"
        f" {another}"
    )


def start_from_matches(
    poses: SE3, pairs: Sequence[ImagePair], mount: Mount, joints: Joints | None = None
) -> HandEyeStart:
    """Solve for the transform from pairs between n frames with `scene_from_parent` (n,)."""
    if len(pairs) < LEAST_PAIRS:
        raise InputError(
            f"only {len(pairs)} pairs of images show the same place from two sides, at least"
            f" {LEAST_PAIRS} are needed: record more views that overlap, of a place with"
            " texture"
        )
    epipolar = _EpipolarFit(poses, pairs, SPREAD_M[mount])
    epipolar.rotation = _first_rotation(poses, pairs, mount)
    starts = epipolar.starts(mount)
    most = np.deg2rad(AGREE_DEG)
    fits = [epipolar.solve(start, np.mean(starts, axis=0)) for start in starts]
    best = min(fits, key=lambda x: np.minimum(epipolar.medians(x), most).mean())
    if joints is not None:
        epipolar.moving = lambda offsets: joints.matrices(offsets, mount)
        still = np.zeros(len(joints.arm.joints))
        best = epipolar.solve(np.r_[best, still], np.r_[np.mean(starts, axis=0), still])
    distance = epipolar.medians(best)
    agree = distance < most
    _refuse_disagreement(agree)
    return HandEyeStart(
        epipolar.transform(best),
        mount,
        int(agree.sum()),
        len(pairs),
        tuple(pair for pair, good in zip(pairs, agree, strict=True) if good),
        float(np.rad2deg(np.median(distance))),
        joints and ArmOffsets.start(joints.arm, mount, best[6:] * joints.arm.free()),
    )


def _refuse_disagreement(agree: BoolArray) -> None:
    if agree.sum() < max(LEAST_PAIRS, LEAST_SHARE * len(agree)):
        raise InputError(
            f"the gripper's motion and the images agree in only {agree.sum()} of {len(agree)} pairs"
            " of frames: check that the poses belong to these images, that they are poses of the"
            " gripper in the base (not the inverse), and the order of their quaternions or angles"
        )


def _first_rotation(poses: SE3, pairs: Sequence[ImagePair], mount: Mount) -> Rotation:
    """The rotation from which the distances of some matches become smallest.

    Essential matrices would give it faster, but those of a small or flat thing may be wrong by any
    angle, and these distances are not.
    """
    some = np.unique(np.linspace(0, len(pairs) - 1, FIRST_PAIRS).round().astype(int))
    epipolar = _EpipolarFit(
        poses, [pairs[i] for i in some], SPREAD_M[mount], FIRST_MATCHES
    )
    scale = np.deg2rad(ANGLE_DEG)
    best = Rotation.identity()
    least = np.inf
    for rotation in spread_rotations(ROTATIONS):
        epipolar.rotation = rotation
        fit = least_squares(
            epipolar.distances,
            np.mean(epipolar.starts(mount), axis=0),
            loss="cauchy",
            f_scale=scale,
            x_scale=X_SCALE,
            max_nfev=15,
        )
        cost = np.minimum(np.abs(epipolar.distances(fit.x)), scale).mean()
        if cost < least:
            best = Rotation.from_rotvec(fit.x[:3]) * rotation
            least = cost
    return best


def spread_rotations(count: int) -> Rotation:
    """(count,) rotations in about equal distances.

    A spiral through all unit quaternions: Alexa, Super-Fibonacci spirals (CVPR 2022).
    """
    share = (np.arange(count) + 0.5) / count
    inner = np.sqrt(share)
    outer = np.sqrt(1 - share)
    a, b = (
        2
        * np.pi
        * count
        * share
        / np.array([[np.sqrt(2)], [1.533751168755204288118041]])
    )
    parts = inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)
    return Rotation.from_quat(np.stack(parts, -1))


class _EpipolarFit:
    """Sampson distances of matches from the epipolar lines of a transform, as angles."""

    def __init__(
        self,
        poses: SE3,
        pairs: Sequence[ImagePair],
        spread_m: float,
        most: int = MATCHES,
    ):
        self.rotation = Rotation.identity()
        self.spread_m = spread_m
        self.matrices = poses.matrix()
        self.pairs = pairs
        self.moving: Callable[[Array], Array] = lambda _: self.matrices
        self.ends = np.array([pair[:2] for pair in pairs])
        some = [
            np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))
            for n in (pair.rays.shape[1] for pair in pairs)
        ]
        rays = [pair.rays[:, take] for pair, take in zip(pairs, some, strict=True)]
        self.first, self.second = np.concatenate(rays, axis=1)
        self.number = np.repeat(np.arange(len(pairs)), [len(take) for take in some])

    def starts(self, mount: Mount) -> list[Array]:
        """First parameters (6,): rotation vector after `rotation`, position."""
        if mount.moves:
            beside = (
                np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * BESIDE_M
            )
            return list(np.pad(beside, ((0, 0), (3, 0))))
        towards = self.rotation.apply(np.concatenate([self.first, self.second]).mean(0))
        towards = towards / np.linalg.norm(towards)
        gripper = np.linalg.inv(self.matrices)[:, :3, 3].mean(0)
        return [np.r_[np.zeros(3), gripper - depth * towards] for depth in DEPTHS_M]

    def solve(self, start: Array, centre: Array) -> Array:
        """Minimise from a start, with a prior about `centre`; all are parameters (6,)."""
        scale = float(np.deg2rad(ANGLE_DEG))
        x = start
        matches = len(self.number) / len(self.pairs)

        def residuals(x: Array, scale: float) -> Array:
            # The matches of a pair share the errors of its poses, so each pair counts as one match.
            spread = np.where(np.arange(len(x)) < 6, self.spread_m, JOINT_SPREAD)[3:]
            away = np.sqrt(matches) * (x - centre)[3:] / spread
            # The loss of these residuals is quadratic: the prior is no outlier.
            prior = (
                scale * np.sign(away) * np.sqrt(np.expm1(np.minimum(away**2, 500.0)))
            )
            return np.r_[self.distances(x), prior]

        for _ in range(3):
            x = least_squares(
                residuals,
                x,
                args=(scale,),
                loss="cauchy",
                f_scale=scale,
                x_scale=np.r_[X_SCALE, np.full(len(x) - 6, X_SCALE[0])],
                max_nfev=50,
            ).x
            scale = min(
                scale, max(3 * float(np.median(np.abs(self.distances(x)))), 1e-4)
            )
        return x

    def distances(self, x: Array) -> Array:
        """(m,) angles of matches from their epipolar planes, radians."""
        camera = self.moving(x[6:]) @ self.transform(x).matrix()
        second_from_first = (
            np.linalg.inv(camera[self.ends[:, 1]]) @ camera[self.ends[:, 0]]
        )
        moved = second_from_first[:, :3, 3]
        direction = moved / np.maximum(
            np.linalg.norm(moved, axis=1, keepdims=True), 1e-9
        )
        essential = (cross_matrix(direction) @ second_from_first[:, :3, :3])[
            self.number
        ]
        by_second = np.einsum("mij,mj->mi", essential, self.first)
        by_first = np.einsum("mji,mj->mi", essential, self.second)
        squares = (by_second[:, :2] ** 2).sum(1) + (by_first[:, :2] ** 2).sum(1)
        return (self.second * by_second).sum(1) / np.sqrt(np.maximum(squares, 1e-12))

    def medians(self, x: Array) -> Array:
        """Median distance of the matches of each pair, radians."""
        distance = np.abs(self.distances(x))
        return np.array(
            [np.median(distance[self.number == i]) for i in range(len(self.pairs))]
        )

    def transform(self, x: Array) -> SE3:
        """parent_from_camera of parameters (6,)."""
        turned = Rotation.from_rotvec(x[:3]) * self.rotation
        return SE3.of(turned, x[3:6])


def image_pairs(
    frames: Sequence[Frame],
    mount: Mount,
    encoder: Encoder,
    on_progress: OnProgress = lambda *_: None,
) -> list[ImagePair]:
    """Similar frames with enough matches, without those that stand still before a fixed camera."""
    images: list[Image] = []
    cameras: list[Camera] = []
    features: list[Float32Array] = []
    fixed = not mount.moves
    for frame in frames:
        image = frame.read_image()
        short_side = min(960 if fixed else 480, *image.shape[:2])
        grey, camera = working_image(image, frame.camera, short_side)
        images.append(grey)
        cameras.append(camera)
        if not fixed:
            features.append(
                encoder.encode(grey, ENCODED_SIDE).reshape(-1, encoder.width)
            )
    pairs = (
        _turned_least(frames)
        if fixed
        else similar_pairs(features, encoder.vlad(features), PARTNERS)
    )
    matched: list[ImagePair] = []
    with ThreadPoolExecutor(cores()) as pool:
        points = list(pool.map(sift_features, images))

        def matched_pair(pair: tuple[int, int]) -> ImagePair | None:
            i, j = pair
            found = epipolar_pair(
                points[i], points[j], cameras[i], cameras[j], STILL_PX * fixed
            )
            if found is None:
                return None
            return ImagePair(i, j, found.rays)

        for done, pair in enumerate(pool.map(matched_pair, pairs), start=1):
            matched += [pair] if pair is not None else []
            on_progress("matching", done, len(pairs))
    return matched


def _turned_least(frames: Sequence[Frame]) -> list[tuple[int, int]]:
    """Pairs of frames, each with those between which the gripper turned least."""
    rotation = stated_grippers(frames).rotation
    pairs = set()
    for i, first in enumerate(rotation):
        nearest = np.argsort((first.inv() * rotation).magnitude(), kind="stable")[1:]
        pairs |= {(min(i, j), max(i, j)) for j in nearest[:PARTNERS].tolist()}
    return sorted(pairs)
