"""From images, joint values and a URDF to the pose of a fixed camera."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evercal.calibration.arm_in_view.covariance import WRONG_LENS, focal_sigmas
from evercal.calibration.arm_in_view.equations import (
    ArmFit,
    Priors,
    TooFewPoints,
    solved,
)
from evercal.calibration.arm_in_view.fit import Fitter
from evercal.calibration.arm_in_view.result import LEAST_CONFIRMED, calibration_of
from evercal.calibration.arm_in_view.starts import Overlap, starts
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, spread
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame, Recording
from evercal.robot.frame_names import FrameNames
from evercal.robot.link_shapes import RobotBody, robot_body
from evercal.robot.pose_errors import ArmErrors
from evercal.robot.robot_model import RobotModel

NOT_RECOGNISED = (
    "the arm was not recognised in the images: is this the URDF of the robot, and are these its"
    " joint values?"
)
LEAST_IMAGES = 3
"""Least number of images."""
MOST_IMAGES = 40
"""Images that are used; of more, some from beginning to end."""
_SLIDING_M = 0.5
"""Offset of a sliding joint for a radian of others."""
DOUBTFUL_LENS = 1.8
"""Change of the focal length, in standard deviations, from which its estimation is tried."""
CONTRADICTED_LENS = 4.0
"""The same after that, from which it is kept."""
SURE_CONFIRMED = 0.3
"""From here, no other start is tried."""
SHORT_IMAGES = 10
"""Images that starts are fitted with."""
_SHORT_PX = (40, 30, 20, 12, 8)
"""How far outlines are searched in the steps of a short fit, in pixels of an image of 640."""
_FINAL_PX = (15, 10, 7, 5, 4, 4, 4)
"""The same of the final fit, at the end in pixels of any image."""
_SPACING_PX = 4.0


def calibrate_arm_in_view(
    recording: Recording,
    model: RobotModel,
    errors: ArmErrors | None = None,
    without: Sequence[str] = (),
    start: SE3 | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> Calibration:
    """Calibrate a fixed camera by the robot arm in its images.

    Args:
        recording: Images of the fixed camera with all joint values, see
            `ReadOptions.whole_robot`; no start is needed.
        model: The robot, with meshes or other visual geometry.
        errors: What is known of the arm.
        without: Links whose mesh is not what is mounted.
        start: base_from_camera to start from, right to some pixels; if omitted, it is searched.
        on_progress: Called with the current step, how much of it is done, and its total.

    Returns:
        base_from_camera, for the estimated intrinsics.

    Raises:
        InputError: The arm does not move, or is not recognised in the images.
    """
    frames = chosen_frames(recording)
    assert recording.arm is not None, "chosen_frames requires joint values"
    base = recording.frames.base or None
    body = robot_body(model, recording.arm.joints, base, without)
    fitter = Fitter(ArmViews.of(frames, body))
    priors = priors_of(body, errors or ArmErrors())
    fit = fit_arm(fitter, priors, start, on_progress)
    names = FrameNames(body.base, "", recording.frames.camera)
    return calibration_of(fit, fitter, frames, names)


def chosen_frames(recording: Recording) -> list[Frame]:
    """Frames with joint values, at most `MOST_IMAGES`."""
    frames = [frame for frame in recording.train if frame.joints_rad is not None]
    if recording.arm is None or not frames:
        raise InputError(
            f"{recording.name}: states no joint values; the arm in view needs those of each image:"
            " joints.csv beside the images, or joint states in a bag"
        )
    if len(frames) < LEAST_IMAGES:
        raise InputError(
            f"{recording.name}: {len(frames)} images with joint values; the arm in view needs"
            f" {LEAST_IMAGES} and more, with the arm at other places in each"
        )
    sizes = {(frame.camera.width, frame.camera.height) for frame in frames}
    if len(sizes) > 1:
        raise InputError(
            f"{recording.name}: its images differ in size; give one camera's"
        )
    return [frames[i] for i in spread(len(frames), MOST_IMAGES)]


def priors_of(body: RobotBody, errors: ArmErrors) -> Priors:
    """Priors of the offsets of joints; those of first joints turn the base, and stay 0."""
    sigma = np.zeros(len(body.joints))
    longest = max(body.arms, key=lambda arm: len(arm.chain))
    slopes = longest.slopes(np.zeros((1, len(longest.joints))))
    rad = errors.offset_rad(slopes)
    for arm in body.arms:
        for joint in arm.chain[1:]:
            name = arm.joints[joint.value]
            if name in body.joints:
                lever_m = 1.0 if joint.rotates else _SLIDING_M
                sigma[body.joints.index(name)] = rad * lever_m
    return Priors(usual=sigma)


def fit_arm(
    fitter: Fitter,
    priors: Priors,
    start: SE3 | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> ArmFit:
    """Fit an arm to its views, from base_from_camera or without a start.

    Raises:
        InputError: The arm does not move, or the images do not show it where it should be.
    """
    views = fitter.views
    zoom = max(views.camera.size) / 640
    if start is None:
        best = _best_start(fitter, priors, zoom, on_progress).estimate
    else:
        best = fitter.start(start.inverse())
    every = range(len(views))
    last = _FINAL_PX[-1]
    reaches = [last + zoom * (reach - last) for reach in _FINAL_PX]
    try:
        fit = fitter.fit(best, priors, every, reaches, _SPACING_PX, is_final=True)
        if focal_sigmas(fit) > DOUBTFUL_LENS:
            unknown = replace(priors, lens_is_free=True, focal=WRONG_LENS)
            other = fitter.fit(
                fit.estimate, unknown, every, reaches[-4:], _SPACING_PX, True
            )
            if focal_sigmas(other) > CONTRADICTED_LENS:
                known = replace(other.priors, lens_is_free=False)
                fit = solved(other.estimate, other.equations, known)
    except (TooFewPoints, np.linalg.LinAlgError):
        raise InputError(NOT_RECOGNISED) from None
    if fit.confirmed < LEAST_CONFIRMED:
        raise InputError(
            f"the images show {100 * fit.confirmed:.0f} % of the outline of the arm at the best"
            f" pose, a right one shows {100 * LEAST_CONFIRMED:.0f} % and more; is this the URDF of"
            " the robot, do the joint values belong to the images, and does the arm move most?"
        )
    return fit


def _best_start(
    fitter: Fitter, priors: Priors, zoom: float, on_progress: OnProgress
) -> ArmFit:
    views = fitter.views
    overlap = Overlap(views, fitter.moving)
    poses = starts(overlap, fitter.reach_m())
    pose_only = replace(priors, pose_only=True)
    few = spread(len(views), SHORT_IMAGES).tolist()
    reaches = [zoom * reach for reach in _SHORT_PX]
    best = None
    for number, pose in enumerate(poses):
        on_progress("trying starts", number, len(poses))
        if best and best.confirmed > SURE_CONFIRMED:
            break
        try:
            fit = fitter.fit(
                fitter.start(pose), pose_only, few, reaches, 2 * _SPACING_PX
            )
        except (TooFewPoints, np.linalg.LinAlgError):
            continue
        if best is None or fit.confirmed > best.confirmed:
            best = fit
    if best is None:
        raise InputError(NOT_RECOGNISED)
    return best
