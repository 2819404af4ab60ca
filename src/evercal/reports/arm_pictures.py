"""Images with the outline of an arm by a calibration, and where the images show it."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from evercal.calibration.arm_in_view.equations import Estimate, Priors
from evercal.calibration.arm_in_view.fit import Fitter
from evercal.calibration.arm_in_view.outline import (
    image_offsets,
    outline_points,
)
from evercal.calibration.arm_in_view.solve import chosen_frames
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.calibration.calibration import Calibration
from evercal.geometry import resize_pixels
from evercal.recordings.frame import Recording
from evercal.reports.calibration_images import MAX_IMAGES, AnnotatedImages
from evercal.reports.overlay import PICTURE_PX, LandmarkPicture, draw_axes, resized
from evercal.reports.page import Table
from evercal.robot.link_shapes import robot_body
from evercal.robot.robot_model import RobotModel
from evercal.typing import Image

_REACHES_PX = (8.0, 4.0)
"""Distances within which an image shows an outline, before and after the background is learned."""
_GREY = (170, 170, 170)
_ORANGE = (255, 140, 40)
_BLUE = (0, 200, 255)


def arm_pictures(
    calibration: Calibration,
    recording: Recording,
    model: RobotModel,
    without: Sequence[str] = (),
) -> AnnotatedImages:
    """Draw the outline of the arm into images of a recording, see `calibrate_arm_in_view`."""
    frames = chosen_frames(recording)
    base = calibration.frames.base or None
    joints = [joint.name for joint in calibration.joints]
    body = robot_body(model, joints, base, without)
    fitter = Fitter(ArmViews.of(frames, body))
    assert calibration.camera is not None, "it states the camera"
    start = fitter.start(calibration.parent_from_child.inverse())
    start = replace(start, camera=calibration.camera.pinhole)
    start.offsets[:] = [joint.offset for joint in calibration.joints]
    priors = Priors(usual=np.zeros(len(joints)), pose_only=True)
    every = range(len(frames))
    equations = fitter.fit(start, priors, every, _REACHES_PX, 2.0, True).equations
    pictures = {}
    for i in np.linspace(0, len(frames) - 1, MAX_IMAGES).astype(int).tolist():
        share = np.mean(equations.image == i) * len(equations.px)
        share /= max(equations.testable[i].sum(), 1)
        words = f"{100 * share:.0f} % of the outline shown"
        pictures[frames[i].name] = LandmarkPicture(_drawn(fitter, start, i), 0, words)
    rows = []
    for link, shape in enumerate(body.links):
        px = np.abs(equations.px[equations.link == link])
        if len(px):
            share = 100 * len(px) / equations.testable[:, link].sum()
            rows.append((shape.link, f"{share:.0f}", f"{np.median(px):.2f}"))
    links = Table(("link", "outline shown (%)", "residual (px)"), rows)
    return AnnotatedImages(pictures, links=links)


def _drawn(fitter: Fitter, estimate: Estimate, i: int) -> Image:
    """Image `i` with the outline."""
    views = fitter.views
    values = views.values[[i]] + estimate.offsets
    base_from_link = views.body.frames(values)[:, 0]
    drawing = fitter.draw(estimate, base_from_link)
    links = estimate.camera_from_base.matrix() @ base_from_link
    points = outline_points(fitter.edges, links, estimate.camera, drawing, 1.0)
    offsets = image_offsets(views, i, points, _REACHES_PX[-1])
    picture = resized(views.images[i], PICTURE_PX)
    pixels = resize_pixels(points.pixels, PICTURE_PX / views.camera.width)
    colours = np.where(offsets.testable[:, None], _ORANGE, _GREY)
    colours[offsets.confirmed] = _BLUE
    for pixel, colour in zip(pixels.round().astype(int), colours, strict=True):
        cv2.circle(picture, pixel.tolist(), 1, colour.tolist(), -1)
    return draw_axes(picture, estimate.camera, estimate.camera_from_base)
