"""`PosePairs`: pairs of gripper pose and camera pose, one for each image, and their corners.

With the intrinsics as extras, the hand-eye equation is the full reprojection problem: what the
corners say about them, and the derivative of each pose by them, come from `boards.corners`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import (
    BEND,
    Bend,
    BoardPose,
    BoardView,
    strays,
)
from evercal.calibration.boards.intrinsics import (
    LENS,
    LensPrior,
    fitted_poses,
    lens_estimate,
)
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.calibration.boards.stated_lens import compared_lens
from evercal.calibration.pose_pairs.pose_equation import Extras, PoseEquation
from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, norms, pose_distance
from evercal.recordings.poses.conventions import PoseConvention
from evercal.robot.mount import MountName, mount_named
from evercal.typing import Array, BoolArray, IntArray, JsonObject, Strings

_SAME_ROBOT_M = 1e-4
"""Distance below which two robot poses are equal."""
_SAME_ROBOT_RAD = np.deg2rad(0.01)
"""Angle below which two robot poses are equal."""
_SAME_CAMERA_M = 5e-3
"""Distance below which two camera poses are equal."""
_SAME_CAMERA_RAD = np.deg2rad(0.5)
"""Angle below which two camera poses are equal."""


@frozen_arrays
class PoseNumbers:
    """The numbers of a pose file, for messages about its convention."""

    numbers: Array
    """(n, k)."""
    convention: PoseConvention
    """Convention in which they were read."""
    camera_from: bool = False
    """Whether the camera's frame is the first of the pose."""

    def __getitem__(self, rows: IntArray) -> Self:
        return replace(self, numbers=self.numbers[rows])


@dataclass(frozen=True, eq=False)
class PosePairs:
    """n pose pairs; the board may be any object with camera poses: a tag, a map, an SfM model."""

    names: Strings
    """(n,) names of images or rows."""
    base_from_gripper: SE3
    """(n,) poses from the robot."""
    camera_from_board: SE3
    """(n,) poses from the images."""
    camera_covariance: Array | None = None
    """(n, 6, 6) covariance of `camera_from_board`, as in `BoardPose`. Default: it is estimated."""
    velocity: Array | None = None
    """(n, 6) gripper velocity in the base frame, m/s and rad/s, to estimate a time offset."""
    robot_numbers: PoseNumbers | None = None
    camera_numbers: PoseNumbers | None = None
    notes: Strings = ()
    """How robot and camera poses were paired."""

    def __post_init__(self) -> None:
        counts = {len(self.names), len(self.base_from_gripper)}
        counts.add(len(self.camera_from_board))
        if self.camera_covariance is not None:
            counts.add(len(self.camera_covariance))
        if len(counts) != 1:
            raise ValueError(
                f"names and poses of pose pairs differ in number: {sorted(counts)}"
            )

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: IntArray | BoolArray) -> Self:
        rows = np.arange(len(self))[index]
        changed: JsonObject = {"names": tuple(self.names[row] for row in rows)}
        for name, value in vars(self).items():
            if name not in ("names", "notes") and value is not None:
                changed[name] = value[rows]
        return replace(self, **changed)

    def distinct(
        self,
        scale_known: bool = True,
    ) -> tuple[IntArray, IntArray]:
        """Return indices of different pairs, sorted by value, and (n,) the first equal pair."""
        robot = self.base_from_gripper
        camera = self.camera_from_board
        keys = [
            *robot.translation_m.T,
            *camera.translation_m.T,
            *_canonical(robot).T,
            *_canonical(camera).T,
        ]
        order = np.lexsort(keys[::-1])
        first = np.empty(len(self), np.int64)
        first[order] = order[self[order].repeats(scale_known)]
        return order[first[order] == order], first

    def repeats(self, scale_known: bool = True) -> IntArray:
        """Return (n,) the index of the first equal pair; the own index for a new pair."""
        # Equal robot poses with different camera poses are no repeats: the robot pose is stale.
        robot = self.base_from_gripper
        camera = self.camera_from_board
        first = np.arange(len(self))
        close = KDTree(robot.translation_m).query_pairs(
            _SAME_ROBOT_M, output_type="ndarray"
        )
        if len(close) == 0:
            return first
        i, j = np.sort(close, 1).T
        _, robot_rad = pose_distance(robot[i], robot[j])
        camera_m, camera_rad = pose_distance(camera[i], camera[j])
        if not scale_known:
            distances = norms(camera.translation_m)
            camera_m = camera_m / max(float(np.median(distances)), 1e-12)
        same = (camera_m < _SAME_CAMERA_M) & (camera_rad < _SAME_CAMERA_RAD)
        same &= robot_rad < _SAME_ROBOT_RAD
        np.minimum.at(first, j[same], i[same])
        while (first[first] != first).any():
            first = first[first]
        return first

    def scaled(self, scale: float) -> Self:
        """Multiply the camera's lengths."""
        camera = self.camera_from_board
        moved = SE3(camera.rotation_wxyz, scale * camera.translation_m)
        return replace(self, camera_from_board=moved)

    def equation(
        self,
        mount: MountName,
        extras: Extras,
    ) -> PoseEquation:
        """Return the equation; the board is fixed in the base for a camera on the arm."""
        mounted = mount_named(mount)
        robot = self.base_from_gripper
        fixed_from_parent = mounted.scene_from_parent(robot)
        covariance = self.camera_covariance
        if covariance is None:
            covariance = np.zeros((len(self), 6, 6))
        velocity = self.velocity
        if velocity is not None and not mounted.moves:
            velocity = _inverse_velocity(robot, velocity)
        return PoseEquation(
            robot_rotation=fixed_from_parent.rotation_matrix(),
            robot_translation=fixed_from_parent.translation_m,
            camera_rotation=self.camera_from_board.rotation_matrix(),
            camera_translation=self.camera_from_board.translation_m,
            camera_covariance=covariance,
            extras=extras,
            base_is_fixed=mounted.moves,
            velocity=velocity,
        )


def _inverse_velocity(base_from_gripper: SE3, velocity: Array) -> Array:
    linear, angular = np.split(velocity, 2, 1)
    gripper_from_base = np.swapaxes(base_from_gripper.rotation_matrix(), 1, 2)
    moved = np.cross(angular, base_from_gripper.translation_m) - linear
    moved = (gripper_from_base @ moved[..., None])[..., 0]
    turned = (gripper_from_base @ -angular[..., None])[..., 0]
    return np.concatenate([moved, turned], 1)


def _canonical(pose: SE3) -> Array:
    quaternion = pose.rotation_wxyz
    largest = np.take_along_axis(
        quaternion,
        np.abs(quaternion).argmax(-1)[:, None],
        -1,
    )
    return quaternion * np.where(largest < 0, -1.0, 1.0)


@frozen_arrays
class BoardCorners:
    """Board corners of the images of pose pairs."""

    camera: Camera
    """Intrinsics of all images."""
    views: tuple[BoardView, ...]
    """One for each pair."""
    half_turn: bool = False
    """Whether the board looks the same after half a turn: its corners may be in reverse order."""
    quarter_turn: bool = False
    """Whether the corners are a square grid, which may be turned by 90 degrees."""
    stated: bool = False
    """Whether the intrinsics are stated by the maker; else they come from these corners."""
    size_m: float | None = None
    """Stated side of a square, or of a tag, for messages."""
    board: Board | None = None
    """The printed board, if it is known."""
    left_out: Strings = ()
    """Images and pixels of corners that leave their neighbours."""

    def turned(self, view: BoardView) -> list[BoardView]:
        """Return a view with the other corners that may have been taken for its corners."""
        angles: tuple[int, ...] = ()
        if self.quarter_turn:
            angles = (90, 180, 270)
        elif self.half_turn:
            angles = (180,)
        middle = Bend.none(self.views).middle
        turned = []
        for angle in angles:
            turn = Rotation.from_euler("z", angle, degrees=True)
            points = turn.apply(view.points_m - middle) + middle
            turned.append(replace(view, points_m=points))
        return turned

    def without_strays(
        self,
        names: Sequence[str],
        poses: Sequence[BoardPose],
    ) -> Self:
        """Leave out corners that leave their neighbours by many sigma."""
        views = []
        left_out = list(self.left_out)
        stray = strays(self.views, poses, self.camera)
        for name, view, mask in zip(names, self.views, stray, strict=True):
            for x, y in view.pixels[mask]:
                left_out.append(f"{name} {x:.0f} {y:.0f}")
            views.append(view[~mask])
        return replace(
            self,
            views=tuple(views),
            left_out=tuple(left_out),
        )

    def contradiction(self) -> str:
        """What the corners say against the stated intrinsics; empty if nothing."""
        if not self.stated or not self.board:
            return ""
        views = {str(i): view for i, view in enumerate(self.views)}
        return compared_lens(board_poses(self.board, self.camera, views))[1]

    @property
    def prior(self) -> LensPrior:
        """Knowledge of the intrinsics without the corners."""
        if self.stated:
            return LensPrior.stated(self.camera)
        return LensPrior.usual(self.camera)


class Measured(NamedTuple):
    """Board poses by corners at one estimate of the intrinsics and of the bend of the board."""

    camera: Camera
    bend: Bend
    poses: list[BoardPose]
    noise: CornerNoise

    @property
    def sigma_px(self) -> float:
        """Standard deviation of a corner coordinate."""
        return self.noise.sigma_px

    def applied_to(self, pairs: PosePairs) -> PosePairs:
        """Return the pairs with these camera poses and their covariances."""
        poses = [pose.camera_from_board for pose in self.poses]
        covariances = [pose.unit_covariance for pose in self.poses]
        return replace(
            pairs,
            camera_from_board=SE3.stack(poses),
            camera_covariance=self.sigma_px**2 * np.stack(covariances),
        )

    def extras(
        self,
        prior: LensPrior,
        accepted: BoolArray,
    ) -> Extras:
        """Return intrinsics and bend as unknowns; corners of `accepted` (n,) are in their prior."""
        poses = [self.poses[row] for row in np.flatnonzero(accepted)]
        change, information = lens_estimate(
            poses, self.sigma_px, self.camera, self.bend, prior
        )
        slopes = np.stack([pose.lens_slope for pose in self.poses])
        names = (*LENS[self.camera.model][: len(change) - len(BEND)], *BEND)
        groups = ("intrinsics",) * len(names)
        return Extras(names, groups, slopes, information, change)


def measured(
    corners: BoardCorners,
    camera: Camera,
    starts: SE3,
    bend: Bend | None = None,
    most_shift_px: float = 0.0,
) -> Measured:
    """Fit the pose of the board in every image from (n,) starts.

    Shifts with the row are at most `most_shift_px`. They would explain wrong intrinsics, too, so
    they are estimated only after these.
    """
    bend = bend or Bend.none(corners.views)
    poses = fitted_poses(corners.views, camera, starts, bend)
    noise = CornerNoise.of(poses, most_shift_px)
    return Measured(camera, bend, noise.weighted(poses), noise)


def middle_of(corners: BoardCorners | None) -> Array:
    """(3,) middle of the board's corners, metres; the origin without corners."""
    if not corners:
        return np.zeros(3)
    return np.mean([view.points_m.mean(0) for view in corners.views], 0)
