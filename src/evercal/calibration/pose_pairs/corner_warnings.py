"""What the corners of all images say about the shutter, the print and the stated intrinsics."""

from collections.abc import Iterator

import numpy as np

from evercal.calibration.boards.corners import BEND, lens_vector
from evercal.calibration.boards.intrinsics import moved_lens
from evercal.calibration.pose_pairs.fit import HandEyeFit
from evercal.calibration.pose_pairs.pairs import BoardCorners, Measured
from evercal.calibration.pose_pairs.pose_equation import PoseEquation
from evercal.geometry import norms

_LENS_SIGMAS = 3.0
"""Deviation of stated intrinsics from the estimate that is reported, standard deviations."""
_STRETCH_SIGMAS = 4.0
"""Significance of a stretched print that is reported, standard deviations."""
_LEAST_STRETCH = 0.001
"""Smaller relative differences of the sides of a square are not reported."""
_LEAST_SHIFT_PX = 0.15
"""Smaller shifts with the row are not reported."""
_SQUARE_MM = 25.0
"""Side of a square in messages where none is stated."""


def corner_warnings(
    fit: HandEyeFit, equation: PoseEquation, corners: BoardCorners, lens: Measured
) -> Iterator[str]:
    """What is not as stated; the fit allows for all of it."""
    shift = lens.noise.row_shift_px
    if shift > max(_LEAST_SHIFT_PX, lens.sigma_px):
        yield (
            f"corners move with the row of the image, by {shift:.2f} px from the first row to the"
            " last: a rolling shutter, or images taken in motion. The uncertainty allows for it;"
            " let the arm stand still at each image, or use a global shutter"
        )
    group = equation.extras.indices("intrinsics")
    change = fit.at.extras[group]
    camera, bend = moved_lens(lens.camera, lens.bend, change)
    stretch = float(bend.terms[0])
    sigma = float(fit.sigma[12 + equation.extras.names.index(BEND[0])])
    if abs(stretch) > max(_STRETCH_SIGMAS * sigma, _LEAST_STRETCH):
        side = _SQUARE_MM
        if corners.size_m is not None:
            side = 1000 * corners.size_m
        yield (
            f"squares measure {side:.2f} x {side * (1 + stretch):.2f} mm: the print is stretched by"
            f" {100 * stretch:+.2f} +- {100 * sigma:.2f} % in one direction. The calibration allows"
            " for it; print the board at true size"
        )
    if not corners.stated:
        return
    stated = corners.prior.mean
    now = lens_vector(camera)
    away = now - stated[: len(now)]
    sigmas = np.abs(away) * np.sqrt(np.diag(corners.prior.information)[: len(now)])
    if sigmas[0] >= _LENS_SIGMAS:
        yield (
            f"the stated focal length is {stated[0]:.1f} px, corners and motions give"
            f" {now[0]:.1f} px: check `camera`, or omit it"
        )
    if (sigmas[4:] >= _LENS_SIGMAS).any():
        pixels = np.array([[0, 0], [camera.width - 1, camera.height - 1]])
        stated_rays = corners.camera.unproject(pixels)
        moved = norms(camera.project(stated_rays) - pixels)
        yield (
            "the stated distortion contradicts the corners, which move by"
            f" {np.nanmax(moved, initial=0.0):.1f} px in the corners of the image: check `camera`,"
            " or omit it"
        )
