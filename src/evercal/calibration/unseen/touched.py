"""Evidence from points that the tool has touched and a person has picked in images."""

from collections.abc import Mapping, Sequence

import numpy as np

from evercal.calibration.evidence import Data, gripper_sigma
from evercal.calibration.framed_pose import FramedPose
from evercal.calibration.from_map.by_points import PICK_SIGMA_PX
from evercal.calibration.picked_points import PickedPoint
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms
from evercal.recordings.poses.pairing import counted
from evercal.storage.text_files import few
from evercal.typing import Array, Strings

TOUCH_M = 5e-4
"""Usual standard deviation per axis between the tool's tip and a touched point."""
DEPTH_M = 0.003
"""Usual standard deviation of a measured depth, besides `DEPTH_SHARE` of it."""
DEPTH_SHARE = 0.015
_TOOL_M = 2e-4
"""Standard deviation of a stated tool offset."""
_TURNED = 0.1
"""Least singular value of the rotations that show where a tool's tip is."""
_MOST_APART_M = 0.02
"""Distance of the touches of one point above which the tool or a name is wrong."""
_DOWN = SE3.exp(np.array([0, 0, 0, np.pi, 0, 0]))
"""Gripper whose tool points down, where only the tip is stated."""


@frozen_arrays
class Touches:
    """Gripper poses while the tip of its tool touched points."""

    names: Strings
    """(k,) of the points; `tip#2` is the point `tip` once more."""
    base_from_gripper: SE3
    """(k,)."""
    tool_m: Array | None = None
    """(3,) tip in the frame of the gripper. Default: estimated."""
    sigma_m: float = TOUCH_M
    """Standard deviation per axis between tip and point."""

    @property
    def points(self) -> list[str]:
        """(k,) names of the touched points."""
        return [name.partition("#")[0] for name in self.names]

    def positions(self, base_from_gripper: SE3, tool_error: Array) -> dict[str, Array]:
        """Points (3,) by name, by gripper poses (k,) and an error (3,) of a stated tool."""
        touched = self.points
        same = np.array(touched)[:, None] == touched
        mean = same / same.sum(1)
        if self.tool_m is not None:
            tip = self.tool_m + tool_error
        else:
            # The tip that the touches of each point agree best on.
            apart = np.eye(len(touched)) - mean
            turns = np.tensordot(apart, base_from_gripper.rotation_matrix(), 1)
            shifts = apart @ base_from_gripper.translation_m
            tip, _, _, sizes = np.linalg.lstsq(turns.reshape(-1, 3), -shifts.ravel())
            if sizes[2] < _TURNED:
                raise InputError(
                    "the touches do not show where the tool's tip is: touch one point in three"
                    " orientations, 30 deg apart (rows tip#1, tip#2, tip#3), or give `tool` X,Y,Z"
                    " in the gripper frame, metres"
                )
        tips = base_from_gripper.apply(tip)
        points = mean @ tips
        far = norms(tips - points)
        if far.max() > _MOST_APART_M:
            raise InputError(
                f"{self.names[far.argmax()]} was touched {far.max():.2g} m from its mean: check the"
                " names, the tool, and that the poses are base_from_gripper in metres"
            )
        return dict(zip(touched, points, strict=True))


def touched_tips(points: Mapping[str, Array], sigma_m: float = TOUCH_M) -> Touches:
    """Touches of which only the tip is known, (3,) in the base frame by name."""
    grippers = SE3.from_translation(np.stack([*points.values()])) @ _DOWN
    return Touches(tuple(points), grippers, np.zeros(3), sigma_m)


def touched_data(
    calibration: FramedPose,
    touches: Touches,
    picks: Sequence[PickedPoint],
    base_from_gripper: Mapping[str, SE3],
    pick_px: float = PICK_SIGMA_PX,
) -> Data:
    """Pixels of touched points, and depths if measured; gripper poses are by names of images."""
    camera = calibration.camera
    if not camera:
        raise InputError("the calibration has no intrinsics, so points have no pixels")
    points = touches.positions(touches.base_from_gripper, np.zeros(3))
    require_usable(picks, points, camera)
    measured = np.stack([[*pick.pixel, pick.depth_m] for pick in picks])
    known = np.isfinite(measured)
    own = np.full(measured.shape, pick_px)
    own[:, 2] = DEPTH_M + DEPTH_SHARE * measured[:, 2]
    k = len(touches.names)
    sigma = np.zeros((k, 6))
    sigma[:, :3] = touches.sigma_m
    grippers = touches.base_from_gripper
    if calibration.on_gripper:
        if not base_from_gripper:
            raise InputError(
                "give the gripper's pose at every image with `robot_poses`"
            )
        taken = [base_from_gripper[pick.image] for pick in picks]
        grippers = SE3.stack([*grippers, *taken])
        of_images = np.tile(gripper_sigma(calibration), (len(picks), 1))
        sigma = np.concatenate([sigma, of_images])

    def seen(own: SE3, grippers: SE3, tool_error: Array) -> Array:
        positions = touches.positions(grippers[:k], tool_error)
        if calibration.on_gripper:
            own = grippers[k:] @ own
        return own.inverse().apply([positions[pick.point] for pick in picks])

    def predict(own: SE3, lens: Array, grippers: SE3, tool_error: Array) -> Array:
        places = seen(own, grippers, tool_error)
        pixels = camera.changed([*lens, 0, 0]).project(places)
        return (np.c_[pixels, places[:, 2]] - measured)[known]

    places = seen(calibration.parent_from_child, grippers, np.zeros(3))
    misses = norms(camera.unproject(measured[:, :2]) * places[:, 2:] - places)
    misses[places[:, 2] <= 0] = np.inf
    labels = [f"{pick.point} in {pick.image}" for pick in picks]
    return Data(
        counted(len(points), "touched point"),
        predict,
        grippers,
        sigma,
        _TOOL_M**2 * np.eye(3),
        own[known],
        places,
        float(norms([*points.values()]).max()),
        dict(zip(labels, misses.tolist(), strict=True)),
    )


def require_usable(
    picks: Sequence[PickedPoint], points: Mapping[str, Array], camera: Camera
) -> None:
    """Refuse picks of points that were not touched, or outside of the image."""
    for image, point, (x, y), _ in picks:
        if point not in points:
            raise InputError(
                f"{image}: {few([point], points)} was picked and not touched; touched are"
                f" {few([*points])}"
            )
        if not (-1 < x < camera.width and -1 < y < camera.height):
            raise InputError(
                f"{image}: point {point!r} at {x:g}, {y:g} lies outside the image of"
                f" {camera.width}x{camera.height} pixels"
            )
