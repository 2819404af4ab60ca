"""Data of a target: poses of a board, or of the scene of a map in which images were located."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from evercal.calibration.boards.board_poses import BoardPoses
from evercal.calibration.evidence import Data, gripper_sigma, plus
from evercal.calibration.framed_pose import FramedPose
from evercal.calibration.located import ImagePose
from evercal.errors import InputError
from evercal.geometry import SE3, UncertainPose, average_poses, deviations, norms
from evercal.recordings.poses.pairing import counted
from evercal.robot.mount import mount_named
from evercal.typing import Array

_PLACED = (*[5e-4] * 3, *[1e-3] * 3)
"""Standard deviations of the stated pose of a target, metres and radians."""


class TargetView(NamedTuple):
    """A target in one image."""

    camera_from_target: UncertainPose
    points: Array
    """Corners or landmarks (k, 3) of the target."""


Target = Mapping[str, TargetView]
"""Views by the names of the images of a thing that stands still, or that the gripper holds."""


def board_target(boards: BoardPoses) -> Target:
    """The board of a file of `detect`."""
    views = {}
    for image in boards.detected:
        pose = image.camera_from_board
        if pose and image.view and image.covariance is not None:
            own = UncertainPose(pose, image.covariance)
            views[image.name] = TargetView(own, image.view.points_m)
    return views


def scene_target(located: Sequence[ImagePose]) -> Target:
    """The scene in which images were located."""
    views = {}
    for item in located:
        if len({*item.estimate.alternatives_in}) > 1:
            raise InputError(f"{item.name}: {item.estimate.reason}")
        if item.is_located and item.estimate.points_m is not None:
            pose = UncertainPose(item.pose, item.covariance).inverse()
            views[item.name] = TargetView(pose, item.estimate.points_m)
    return views


def target_data(
    calibration: FramedPose,
    target: Target,
    base_from_gripper: Mapping[str, SE3],
    base_from_target: SE3 | None = None,
) -> Data:
    """Poses of a target by the calibration, beside each other or beside a stated one.

    It stands still in the base before a camera on the gripper, and the gripper carries it before a
    fixed camera, unless `base_from_target` is known. Gripper poses are by the names of images.
    """
    known = base_from_target is not None
    fixed = known and not calibration.on_gripper
    n = len(target)
    if n < 2 - known:
        raise InputError(
            f"{counted(n, 'image')} with the target; give two or more from places that turn about"
            " two axes, or its pose with `target_pose`"
        )
    if not fixed and not base_from_gripper:
        raise InputError("give the gripper's pose at every image with `robot_poses`")
    grippers = SE3.identity((n,))
    sigma = np.zeros((n, 6))
    if not fixed:
        grippers = SE3.stack([base_from_gripper[name] for name in target])
        sigma += gripper_sigma(calibration)
    poses, points = zip(*target.values(), strict=True)
    camera_from_target = SE3.stack([pose.pose for pose in poses])
    middles = np.stack([np.median(own, 0) for own in points])
    places = camera_from_target.apply(middles)
    to_scene = mount_named(calibration.mount).scene_from_parent

    def predict(own: SE3, lens: Array, grippers: SE3, other: Array) -> Array:
        error = other[6:].reshape(n, 6).copy()
        # A longer focal length moves the target away.
        error[:, 2] += lens[0] * places[:, 2]
        seen = to_scene(grippers) @ own @ plus(camera_from_target, error)
        return deviations(seen, plus(centre, other[:6])).ravel()

    own = calibration.parent_from_child
    seen = to_scene(grippers) @ own @ camera_from_target
    centre = base_from_target or average_poses(seen)
    misses = norms(seen.apply(middles) - centre.apply(middles))
    base_from_camera = grippers @ own if calibration.on_gripper else own
    placed = np.diag(np.square(_PLACED)) if known else np.eye(6)
    return Data(
        counted(n, "image"),
        predict,
        grippers,
        sigma,
        np.asarray(block_diag(placed, *[pose.covariance for pose in poses])),
        np.zeros(6 * n),
        places,
        float(norms(base_from_camera.apply(places)).max()),
        dict(zip(target, misses.tolist(), strict=True)),
        6 * (not known),
    )
