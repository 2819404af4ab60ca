"""`align`: transform a scene that was learned in a frame of its own to the robot's base frame.

A phone video gives a map with an arbitrary frame, and perhaps scale. A few images from a camera on
the gripper determine the base: with gripper poses A, map poses B of the camera and
X = gripper_from_camera, A X = Z B holds for Z = base_from_map, and both are estimated together.
Alternatively, points that the tool has touched are picked in images.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evercal.calibration.located import ImagePose, locate, poses_of
from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, axis_deviation, cross_matrix
from evercal.localization.intrinsics import cameras_in_scenes
from evercal.mapping.map_frame import MapFrame, Similarity
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import NamedPictures
from evercal.storage.text_files import few
from evercal.typing import Array, ArrayPair, Image, Pair, Strings

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


def _in_own_frame(localizer: "Localizer", name: str) -> "Localizer":
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
    localizer = _in_own_frame(localizer, scene)
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
    return _about(origin, middle), axis_deviation(middle)


def align_by_points(
    localizer: "Localizer",
    scene: str,
    points: Mapping[str, Array],
    picks: Sequence[tuple[str, Image, Mapping[str, Array]]],
    scale_known: bool = True,
) -> MapAlignment:
    """Estimate the base frame from touched points.

    Args:
        localizer: Localizer of the store.
        scene: Name of the scene.
        points: (3,) by name, base frame, metres.
        picks: (name, (h, w, 3) uint8 RGB, pixels (2,) by name of the point) of each image.
        scale_known: Whether the scene was learned in metres.
    """
    images = located_picks(localizer, scene, points, picks)
    similarity, whole, residual_px = fit_picks(images, scale_known)
    positions = np.stack([*points.values()])
    middle = np.mean([*points.values()], axis=0)
    radius = np.sqrt(((positions - middle) ** 2).sum(1).mean() / 3)
    covariance = whole[:6, :6].copy()
    covariance[:3, :3] += np.eye(3) * whole[6, 6] * radius**2
    return MapAlignment(
        similarity,
        covariance,
        len(points),
        len(points),
        f"{residual_px:.1f} px root mean square",
        None,
        axis_deviation(_about(-middle, whole[:6, :6])),
    )


def located_picks(
    localizer: "Localizer",
    scene: str,
    points: Mapping[str, Array],
    picks: Sequence[tuple[str, Image, Mapping[str, Array]]],
) -> "list[Picks]":
    """Picks of the images that are located in the own frame of a scene, two at least."""
    localizer = _in_own_frame(localizer, scene)
    images = []
    learned = localizer.contents.scene(scene)
    for name, image, pixels in picks:
        [item] = locate(localizer, [(name, image)])
        if not item.is_located or item.estimate.scene != scene:
            continue
        # The pose holds for the intrinsics that were estimated with it.
        camera = item.estimate.camera or cameras_in_scenes(None, image, [learned])[0]
        untouched = [key for key in pixels if key not in points]
        if untouched:
            raise InputError(
                f"{name}: the picks name {few(untouched, points)}, which `points` does not"
                f" give; it gives {few(list(points))}"
            )
        touched = np.stack([points[key] for key in pixels])
        picked = np.stack([*pixels.values()])
        sigma = float(np.sqrt(np.trace(item.covariance[:3, :3]) / 3))
        images.append(Picks(item.pose, camera, touched, tuple(pixels), picked, sigma))
    if len(images) < 2:
        raise InputError(
            f"{len(images)} of {len(picks)} images with picks were located in {scene}; at least"
            " two are needed"
        )
    return images


def _about(point: Array, covariance: Array) -> Array:
    adjoint = SE3.from_translation(point).adjoint()
    return adjoint @ covariance @ adjoint.T


PICK_SIGMA_PX = 1.0
"""Least standard deviation of a pixel that a person picked."""


class Picks(NamedTuple):
    """One image with the points that were picked in it."""

    map_from_camera: SE3
    camera: Camera
    points: Array
    """(k, 3) in the base frame, metres."""
    names: Strings
    pixels: Array
    """(k, 2)."""
    sigma_m: float = 0.0
    """Standard deviation of the position of the camera per axis, unit of the map."""


def fit_picks(
    images: Sequence[Picks], scale_known: bool
) -> tuple[Similarity, Array, float]:
    """Estimate the pose and, unless it is known, the scale of a map in the base frame.

    Also return the covariance (7, 7) of a small motion (v, w) of the base frame and of the
    logarithm of the scale, and the root mean square distance of the picks in pixels.
    """
    found = triangulated(images)
    if len(found) < 3:
        raise InputError(
            f"{len(found)} points were picked in two or more images; give at least three,"
            " each in two images from different places"
        )
    in_map = np.stack([point for point, _ in found.values()])
    in_base = np.stack([point for _, point in found.values()])
    start = umeyama(in_map, in_base, scale_known)
    centre = in_base.mean(0)
    before = start.base_from_map.rotation
    shift = start.base_from_map.translation_m - centre

    def moved(small: Array) -> Similarity:
        growth = 1.0
        if not scale_known:
            growth = float(np.exp(small[6]))
        rotation = Rotation.from_rotvec(small[3:6])
        translation = rotation.apply(shift) * growth + centre + small[:3]
        return Similarity(SE3.of(rotation * before, translation), start.scale * growth)

    def residuals(small: Array) -> Array:
        return np.concatenate([_distances(image, moved(small)) for image in images])

    fit = least_squares(
        residuals, np.zeros(6 if scale_known else 7), loss="cauchy", f_scale=2.0
    )
    rest = residuals(fit.x)
    count = len(fit.x)
    freedom = max(len(rest) - count, 1)
    sigma = max(np.sqrt((rest**2).sum() / freedom), PICK_SIGMA_PX)
    covariance = np.zeros((7, 7))
    information = fit.jac.T @ fit.jac
    covariance[:count, :count] = sigma**2 * np.linalg.inv(information)
    # From a motion about the points' centre to one about the base's origin.
    slope = np.eye(7)
    slope[:3, 3:6] = cross_matrix(centre)
    rms = float(np.sqrt((rest.reshape(-1, 2) ** 2).sum(1).mean()))
    return moved(fit.x), slope @ covariance @ slope.T, rms


def _distances(image: Picks, similarity: Similarity) -> Array:
    in_map = similarity.base_from_map.inverse().apply(image.points) / similarity.scale
    in_camera = image.map_from_camera.inverse().apply(in_map)
    pixels = image.camera.project(in_camera)
    return np.nan_to_num(pixels - image.pixels, nan=1e3).ravel()


def triangulated(images: Sequence[Picks]) -> dict[str, ArrayPair]:
    """Return each point that two images show in the map and in the base, by name."""
    centres = defaultdict(list)
    across = defaultdict(list)
    base: dict[str, Array] = {}
    for image in images:
        rotation = image.map_from_camera.rotation_matrix()
        for name, point, pixel in zip(
            image.names, image.points, image.pixels, strict=True
        ):
            ray = rotation @ image.camera.unproject(pixel)
            if np.isfinite(ray).all():
                across[name].append(np.eye(3) - np.outer(ray, ray) / (ray @ ray))
                centres[name].append(image.map_from_camera.translation_m)
                base[name] = point
    points = {}
    for name, point in base.items():
        total = np.sum(across[name], axis=0)
        if len(across[name]) >= 2 and np.linalg.cond(total) <= 1e6:
            right = np.einsum("nij,nj->i", across[name], centres[name])
            points[name] = (np.linalg.solve(total, right), point)
    return points


def require_spread(points: Array) -> None:
    """Refuse points (n, 3) on one line."""
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if spread[1] < 0.02 * spread[0]:
        raise InputError(
            "the touched points lie on one line, so what they hold could turn about it; touch a"
            " point beside the line too"
        )


def umeyama(source: Array, target: Array, scale_known: bool) -> Similarity:
    """The similarity that moves points (n, 3) to others (n, 3), by least squares."""
    a = source - source.mean(0)
    b = target - target.mean(0)
    require_spread(b)
    rotation = Rotation.align_vectors(b, a)[0]
    scale = 1.0
    if not scale_known:
        scale = float((b * rotation.apply(a)).sum() / (a**2).sum())
    shift = target.mean(0) - scale * rotation.apply(source.mean(0))
    return Similarity(SE3.of(rotation, shift), scale)
