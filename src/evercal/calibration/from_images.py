"""`calibrate`: the pose of a camera from images of a mapped scene.

The images are located one by one, and their poses are fused. A camera that stands still
(eye-to-hand) observes the scene from one spot, a camera on the gripper (eye-in-hand) from many, see
`from_map.spots`. Where the scene is a thing in the gripper, the fixed camera is solved for together
with the grip if that has changed, see `held_thing.held_again`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from evercal.calibration.calibration import Calibration, ErrorTerm, largest_term
from evercal.calibration.checks import Checks
from evercal.calibration.from_map.spots import from_many_spots, from_one_spot
from evercal.calibration.held_thing.held_again import HeldAgain, held_again
from evercal.calibration.image_source import Images
from evercal.calibration.located import (
    Fused,
    ImagePose,
    fuse,
    halves_apart,
    in_parent_frame,
    locate,
    mean_covariance,
    of_cause,
    poses_of,
    shows_held_thing,
)
from evercal.calibration.verdict import verdict
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, deviations, norms
from evercal.geometry.camera import COEFFICIENTS
from evercal.geometry.rays import fit_rays
from evercal.localization.intrinsics import STATED, cameras_in_scenes
from evercal.recordings.images import pixels_of
from evercal.robot.frame_names import FrameNames
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount, MountName, mount_named
from evercal.typing import JsonObject

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer
    from evercal.mapping.scene_map import SceneMap

CONTRADICTED_PX = 1.0
"""Stated intrinsics are replaced if the estimate moves rays by more than this, in pixels."""
STILL_M = 0.01
"""Median distance of the positions of a camera that stands still from their mean, metres."""
STILL_RAD = np.deg2rad(1.0)
"""The same of its rotations, radians."""
ENOUGH_IMAGES = 5
"""From this number of images, more images from one spot improve little."""


@frozen_arrays
class _View:
    """Images of one camera, located and fused."""

    mount: Mount
    held: bool
    """Whether the scene is a thing in the gripper."""
    located: Sequence[ImagePose]
    """The images with poses in the scene."""
    parent_from_scene: SE3 | None
    """(n,) pose at each image; None if the scene and the camera both stand still in the base."""
    in_parent: Sequence[ImagePose]
    """The images with the pose of the camera in its parent frame."""
    fused: Fused
    """Mean of `in_parent`."""
    names: FrameNames


def calibrate(
    localizer: "Localizer",
    given: Images,
    mount: MountName | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> Calibration:
    """Estimate the pose of a camera from images of a mapped scene, see `Map.calibrate`.

    `mount` is eye_in_hand by default if there are gripper poses and the camera moves.
    """
    stated_mount = _stated_mount(mount, given)
    located = locate(localizer, given.images, given.camera, on_image)
    view = _view(localizer, given, located, stated_mount)
    fused = view.fused
    scene = localizer.contents.metric_scene(fused.scene)
    first = pixels_of(fused.select(given.images)[0][1])
    source = {
        "command": "calibrate",
        "scene": fused.scene,
        "map": scene.digest,
        "intrinsics": "given" if given.camera else "map",
    }
    height, width = first.shape[:2]
    stated = cameras_in_scenes(given.camera, first, [scene])[0]
    estimated = estimated_camera(fused.select(located), stated)
    lenses = {"estimated": estimated.resized(width, height)}
    own = given.camera or scene.camera
    if own.fits(width, height):
        lenses["stated"] = own.resized(width, height)
    grip = None
    if view.held and given.base_from_gripper:
        grip = held_again(located, given.base_from_gripper)
    if grip:
        camera = lenses["estimated"]
        return _held_thing_calibration(grip, view, camera, source)
    if not view.parent_from_scene:
        uncertainty = from_one_spot(view.in_parent, fused)
    else:
        uncertainty = from_many_spots(
            located,
            view.in_parent,
            fused,
            view.parent_from_scene,
            scene.frame.base_covariance,
        )
    calibration = Calibration(
        mount=view.mount.name,
        parent_from_child=fused.pose,
        covariance=uncertainty.covariance,
        frames=view.names,
        camera=stated.resized(width, height),
        lenses=lenses,
        images=fused.uses,
        error_terms=uncertainty.terms,
        checks=_checks(view),
        source=source,
    ).for_lens("estimated")
    advice = _advice(calibration, fused, estimated, stated)
    return replace(calibration, verdict=" ".join([verdict(calibration), *advice]))


def _stated_mount(mount: MountName | None, given: Images) -> Mount | None:
    stated = None if mount is None else mount_named(mount)
    if stated == EYE_IN_HAND and not given.base_from_gripper:
        raise InputError(
            "eye_in_hand needs the gripper's pose at every image: give `robot_poses`"
        )
    return stated


def _view(
    localizer: "Localizer",
    given: Images,
    located: Sequence[ImagePose],
    mount: Mount | None,
) -> _View:
    """Fuse located images in the frame that carries the camera."""
    grippers = given.base_from_gripper
    held = shows_held_thing(localizer, located, grippers)
    if held and mount == EYE_IN_HAND:
        raise InputError(
            "eye_in_hand: the gripper holds the scene, which shows fixed cameras only"
        )
    if not mount:
        mount = EYE_IN_HAND
        if held or not grippers or _stands_still(located):
            mount = EYE_TO_HAND
    parent_from_scene = None
    in_parent = located
    if grippers and (held or mount.moves):
        parent_from_scene = grippers if held else grippers.inverse()
        in_parent = in_parent_frame(located, parent_from_scene)
    fused = fuse(in_parent)
    names = _names(given, localizer.contents.scene(fused.scene), held)
    return _View(mount, held, located, parent_from_scene, in_parent, fused, names)


def _held_thing_calibration(
    grip: HeldAgain, view: _View, camera: Camera, source: JsonObject
) -> Calibration:
    """The calibration that was solved for together with another grip of the thing."""
    assert view.parent_from_scene, "the gripper holds the scene"
    by_lens = in_parent_frame(of_cause(view.located, lens=True), view.parent_from_scene)
    shown = [item for item in by_lens if item.is_located]
    lens = mean_covariance(shown) / len(shown)
    calibration = grip.solution.calibration()
    return replace(
        calibration,
        covariance=calibration.covariance + lens,
        error_terms=(*calibration.error_terms, ErrorTerm.of("lens", lens)),
        camera=camera,
        frames=view.names,
        source=source,
        verdict=f"{calibration.verdict} {grip.sentence}",
    )


def _names(given: Images, scene: "SceneMap", held: bool) -> FrameNames:
    """The camera is that of the images, and not the one that recorded the scene."""
    role = "gripper" if held else "base"
    own = FrameNames(**{role: vars(scene.frames)[role]})
    names = own.completed_by(given.frames, f"scene {scene.name}")
    if not given.base_from_gripper:
        names = replace(names.or_of(scene.frames), camera=names.camera)
    return names


def _checks(view: _View) -> Checks:
    fused = view.fused
    poses = poses_of(fused.select(view.in_parent))
    millimetres, degrees = halves_apart(poses) or (None, None)
    return Checks(
        images_given=len(view.in_parent),
        images_used=int(fused.used.sum()),
        # `check` compares it with the scatter of later images.
        image_scatter=fused.scatter.tolist(),
        repeatability_mm=millimetres,
        repeatability_deg=degrees,
    )


def estimated_camera(used: Sequence[ImagePose], stated: Camera) -> Camera:
    """The stated intrinsics, or the median of those of the images if they contradict these."""
    rows = []
    for item in used:
        camera = item.estimate.camera
        if camera:
            numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
            rows.append([*numbers, *camera.coefficients])
    if not rows:
        return stated
    fx, fy, cx, cy, *distortion = np.median(rows, axis=0).tolist()
    terms = tuple(distortion[: len(COEFFICIENTS[stated.model])])
    median = replace(stated, fx=fx, fy=fy, cx=cx, cy=cy, distortion=terms)
    # Compare angles between rays: the principal point trades against the rotation.
    if stated.fx * fit_rays(stated, median).left_rad.max() > CONTRADICTED_PX:
        return median
    return stated


def _stands_still(located: Sequence[ImagePose]) -> bool:
    fused = fuse(located)
    shown = [item for item in located if item.is_located]
    if len(shown) < 2:
        raise InputError(
            "one located image does not show whether the camera moves with the gripper: state it"
            " with `mount`, or give images of more gripper poses"
        )
    deviation = deviations(poses_of(shown), fused.pose).reshape(-1, 2, 3)
    metres, radians = np.median(norms(deviation), axis=0)
    return bool(metres < STILL_M and radians < STILL_RAD)


def _advice(
    calibration: Calibration, fused: Fused, camera: Camera, stated: Camera
) -> list[str]:
    advice = []
    if camera != stated:
        advice.append(
            f"The stated intrinsics (focal length {stated.fx:.1f} px) do not fit the images, which"
            f" suggest {camera.fx:.1f} px: the estimated intrinsics were used."
        )
    advice += _lens_advice(calibration)
    if calibration.source["intrinsics"] == "map" and camera == stated:
        advice.append(
            f"The intrinsics are those of the camera that recorded {fused.scene}: give `camera` if"
            " another camera took these images."
        )
    used = int(fused.used.sum())
    lost = int((~fused.used).sum())
    if lost > used:
        advice.append(
            f"{lost} of {used + lost} images were rejected: the camera may have moved between them,"
            " see the reasons."
        )
    if used == 1:
        advice.append(
            "It rests on one image: give five or more to measure their scatter."
        )
    elif not calibration.on_gripper and used >= ENOUGH_IMAGES:
        advice.append(
            "More images from this spot will not help: the remaining error is common to all of"
            " them."
        )
        if largest_term(calibration.error_terms)[0] in ("view", "map"):
            advice.append("Keyframes nearer to the camera's view would.")
    return advice


def _lens_advice(calibration: Calibration) -> list[str]:
    name, share = largest_term(calibration.error_terms)
    if name != "lens":
        return []
    given = calibration.source["intrinsics"] == "given"
    if given:
        more = "a view with more depth determines"
        if calibration.on_gripper:
            more = "images from more spots determine"
        percent = f"{100 * STATED.focal:g}"
        advice = f"`camera` counts as known to {percent} % of the focal length; {more} it better"
    else:
        advice = (
            "give `camera` with intrinsics from images of a board ('evercal detect')"
        )
        if calibration.on_gripper:
            advice += ", or images from more spots"
    return [
        f"The lens is the largest term, {100 * share:.0f} % of the position's variance: {advice}."
    ]
