"""From images, joint values and a URDF to the pose of a fixed camera."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evercal.calibration.arm_in_view.fit import (
    ArmFit,
    Estimate,
    Fitter,
    Priors,
    TooFewPoints,
)
from evercal.calibration.arm_in_view.starts import Overlap, starts
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.errors import InputError
from evercal.progress import OnProgress
from evercal.typing import Array, IntArray

FIRST_STARTS = 4
"""Starts that are fitted; the others only if none of them is confirmed."""
LEAST_CONFIRMED = 0.2
"""Least share of the outline that the images show at the right pose."""
SURE_CONFIRMED = 0.3
"""From here, no other start is tried."""
SHORT_IMAGES = 10
"""Images that starts are fitted with."""
_SHORT_PX = (40, 30, 20, 12, 8)
"""How far outlines are searched in the steps of a short fit, in pixels of an image of 640."""
_FINAL_PX = (15, 10, 7, 5, 4, 4, 4)
_LEARN_AT = (0, 2, 4)
"""Steps of the final fit in which the background is learned again."""
_SPACING_PX = 4.0


def fit_views(
    views: ArmViews, priors: Priors, on_progress: OnProgress = lambda *_: None
) -> ArmFit:
    """Fit an arm to its views, without a start."""
    fitter = Fitter(views)
    if not fitter.moving.any():
        raise InputError("the arm does not move; record it at poses far apart")
    zoom = max(views.size) / 640
    best = _best_start(fitter, priors, zoom, on_progress)
    every = range(len(views))
    reaches = [zoom * reach for reach in _FINAL_PX]
    return fitter.fit(best.estimate, priors, every, reaches, _SPACING_PX, _LEARN_AT)


def _best_start(
    fitter: Fitter, priors: Priors, zoom: float, on_progress: OnProgress
) -> ArmFit:
    views = fitter.views
    overlap = Overlap(views, fitter.moving)
    poses = starts(overlap, reach_of(fitter))
    pose_only = replace(priors, focal=0, centre_px=0, outline_px=0, joints=0 * priors.joints)
    few = np.linspace(0, len(views) - 1, min(SHORT_IMAGES, len(views)))
    few = np.unique(few.round().astype(int))
    reaches = [zoom * reach for reach in _SHORT_PX]
    best = None
    for number, pose in enumerate(poses):
        on_progress("trying starts", number, len(poses))
        if number >= FIRST_STARTS and best and best.confirmed > SURE_CONFIRMED:
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
        raise InputError(
            "the arm was not recognised in the images: is this the URDF of the robot, and are"
            " these its joint values?"
        )
    return best


def reach_of(fitter: Fitter) -> float:
    """Radius of the space in which the links move, metres."""
    views = fitter.views
    frames = views.body.frames(views.values)[fitter.moving]
    places = frames[..., :3, 3].reshape(-1, 3)
    return float(np.linalg.norm(places - places.mean(0), axis=1).max())
