"""`align`: transform a scene that was learned in a frame of its own to the robot's base frame.

A phone video gives a map with an arbitrary frame, and perhaps scale. A few images from a camera on
the gripper determine the base: with gripper poses A, map poses B of the camera and
X = gripper_from_camera, A X = Z B holds for Z = base_from_map, and both are estimated together.
`by_points` and `by_board` do without a robot that moves the camera.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from evercal.calibration.located import ImagePose, locate, poses_of
from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, axis_deviation, cross_matrix
from evercal.mapping.map_frame import MapFrame, Similarity
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import NamedPictures
from evercal.typing import Array, Pair, Strings

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

LEAST_LOCATED = 5
"""Least number of located images that align a map."""


@frozen_arrays
class MapAlignment:
    """Pose and scale of a map in the base frame."""

    similarity: Similarity
    base_covariance: Array
    """(6, 6), see `MapFrame.base_covariance`."""
    used: int
    """Images or points used, of those `given`."""
    given: int
    residual: str
    """Root mean square residual, with its unit."""
    gripper_from_camera: SE3 | None = None
    """Estimated pose of the camera on the gripper, or of the board that it holds."""
    sigma: Pair = (0.0, 0.0)
    """Standard deviation per axis in the middle of the scene, millimetres and degrees."""
    warnings: Strings = ()
    """What the robot's motions contradict."""
    left_out: Strings = ()
    """Names of images that were not located, or are outliers."""

    def applied_to(self, scene: SceneMap) -> SceneMap:
        """Return the scene with answers in the base frame, whatever its recording stated."""
        frame = MapFrame(
            pose_sigma=scene.frame.pose_sigma,
            similarity=self.similarity,
            base_covariance=self.base_covariance,
        )
        return replace(scene, frame=frame)


def in_own_frame(localizer: "Localizer", name: str) -> "Localizer":
    """A localizer of one scene in its own frame."""
    from evercal.localization.localizer import Localizer

    contents = localizer.contents.within([name])
    scene = contents.scene(name)
    frame = MapFrame(pose_sigma=scene.frame.pose_sigma)
    contents = contents.with_replaced(0, replace(scene, frame=frame))
    return Localizer(contents, localizer.options)


def align_by_gripper(
    localizer: "Localizer",
    scene: str,
    images: NamedPictures,
    base_from_gripper: SE3,
    scale_known: bool = True,
    camera_from_board: Mapping[str, SE3] | None = None,
) -> MapAlignment:
    """Estimate the base frame from images of a camera on the gripper, or of a board that it holds.

    Args:
        localizer: Localizer of the store.
        scene: Name of the scene; its previous alignment is ignored.
        images: Of five or more places that turn about two axes.
        base_from_gripper: (n,) gripper poses.
        scale_known: Whether the scene was learned in metres.
        camera_from_board: By image name, for a fixed camera and a board in the gripper; images
            without a board are left out.
    """
    localizer = in_own_frame(localizer, scene)
    if camera_from_board is not None and not scale_known:
        raise InputError(
            "a board in the gripper is seen in metres, the map is not: bring it into the base"
            " frame by a camera on the gripper or by touched points"
        )
    rows, located = _located_in(localizer, scene, images, camera_from_board)
    if len(located) < LEAST_LOCATED:
        raise InputError(
            f"{len(located)} of {len(images)} images were located in {scene}; give at least"
            f" {LEAST_LOCATED} that show it from places that turn about two axes"
        )
    map_from_camera = poses_of(located)
    names = tuple(item.name for item in located)
    grippers = base_from_gripper[np.array(rows)]
    pairs = PosePairs(names, grippers, map_from_camera.inverse())
    solution = solve_pose_pairs(pairs, "eye_in_hand", scale_known, of_board=False)
    fit = solution.fit
    similarity = Similarity(fit.at.fixed_from_board, solution.board_scale)
    size = 12 + solution.equation.extras.names.index("size")
    covariance, sigma = _frame_covariance(fit, similarity, map_from_camera, size)
    residual = fit.residual[fit.inliers].reshape(-1, 2, 3)
    used = {name for name, inlier in zip(names, fit.inliers, strict=True) if inlier}
    metres, radians = np.sqrt((residual**2).sum(2).mean(0))
    return MapAlignment(
        similarity,
        covariance,
        int(fit.inliers.sum()),
        len(images),
        f"{1000 * metres:.1f} mm and {np.rad2deg(radians):.2f} deg root mean square",
        fit.at.parent_from_camera,
        sigma,
        solution.warnings,
        tuple(name for name, _ in images if name not in used),
    )


def _located_in(
    localizer: "Localizer",
    scene: str,
    images: NamedPictures,
    camera_from_board: Mapping[str, SE3] | None,
) -> tuple[list[int], list[ImagePose]]:
    """Rows of the images that are located in a scene, and their poses, or those of the boards."""
    rows = []
    located = []
    for row, item in enumerate(locate(localizer, images)):
        if not item.is_located or item.estimate.scene != scene:
            continue
        if camera_from_board is not None:
            if item.name not in camera_from_board:
                continue
            # The gripper carries the board, so the board replaces the camera.
            pose = item.pose @ camera_from_board[item.name]
            item = replace(item, pose=pose)
        rows.append(row)
        located.append(item)
    return rows, located


def _frame_covariance(
    fit: HandEyeFit, similarity: Similarity, map_from_camera: SE3, size: int
) -> tuple[Array, Pair]:
    """Covariance of the base frame as one motion of it, and sigmas in the middle of the cameras."""
    whole = fit.covariance
    picked = np.r_[6:12, size]
    of_frame = whole[np.ix_(picked, picked)]
    rotation = similarity.base_from_map.rotation_matrix()
    centre = map_from_camera.translation_m.mean(0)
    arm = similarity.scale * rotation @ centre
    slope = np.zeros((6, len(picked)))
    slope[:3, :3] = np.eye(3)
    slope[:3, 3:6] = -cross_matrix(arm) @ rotation
    slope[3:, 3:6] = rotation
    slope[:3, 6] = arm
    middle = slope @ of_frame @ slope.T
    # Away from the middle of the cameras, an error of scale is an error of position.
    distance2 = ((map_from_camera.translation_m - centre) ** 2).sum(1)
    radius = np.sqrt(distance2.mean() / 3)
    middle[:3, :3] += np.eye(3) * of_frame[6, 6] * (similarity.scale * radius) ** 2
    origin = arm + similarity.base_from_map.translation_m
    return about(origin, middle), axis_deviation(middle)


def about(point: Array, covariance: Array) -> Array:
    """The covariance (6, 6) of a small motion of the base frame, about another point (3,)."""
    adjoint = SE3.from_translation(point).adjoint()
    return adjoint @ covariance @ adjoint.T
