"""The pose of a camera by the outlines of an arm: robust Gauss-Newton, drawn anew in each step."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from evercal.calibration.arm_in_view.equations import (
    JOINTS,
    ArmFit,
    Equations,
    Estimate,
    Priors,
    solved,
)
from evercal.calibration.arm_in_view.outline import (
    LinkEdges,
    OutlinePoints,
    image_offsets,
    link_edges,
    outline_points,
)
from evercal.calibration.arm_in_view.rasterizer import Rasterizer
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.typing import Array, BoolArray, IntArray

_FIRST_STEPS = 2
"""Steps of a final fit before the size of joint offsets is estimated."""
_MOVES = 0.3
"""Least way of the middle of a link that moves, in its sizes."""
_ROUGH = 0.004
"""Cells in which vertices are merged where only the place of links counts, in reaches."""


class Shown(NamedTuple):
    """The arm in one image."""

    number: int
    """Of the image."""
    base_from_link: Array
    """(links, 4, 4)."""
    slopes: Array
    """(links, 6, k) see `RobotBody.slopes`."""
    drawing: IntArray
    """(h, w) see `Rasterizer.draw`."""


class Search(NamedTuple):
    """How outlines are searched in an image."""

    edges: list[LinkEdges]
    reach_px: float
    """Largest distance from the drawn outline."""
    spacing_px: float
    """Distance of its points."""


class Fitter:
    """Fits outlines of a body to views."""

    def __init__(self, views: ArmViews) -> None:
        self.views = views
        self.moving = moving_links(views)
        if not self.moving.any():
            raise InputError("the arm does not move; record it at poses far apart")
        shapes = views.body.links
        rough = [shape.simplified(_ROUGH * self.reach_m()) for shape in shapes]
        self._rasterizer = Rasterizer(rough)
        self.edges = [*map(link_edges, shapes)]
        self._rough_edges = [*map(link_edges, rough)]

    def fit(
        self,
        start: Estimate,
        priors: Priors,
        images: Sequence[int],
        reaches_px: Sequence[float],
        spacing_px: float,
        is_final: bool = False,
    ) -> ArmFit:
        """Fit the outlines of images.

        A final fit learns the background again, takes the whole meshes, and estimates the size of
        joint offsets.
        """
        estimate = start
        fit = None
        for number, reach in enumerate(reaches_px):
            values = self.views.values + estimate.offsets
            frames = self.views.body.frames(values)
            slopes = self.views.body.slopes(values)
            drawings = [self.draw(estimate, frames[:, i]) for i in images]
            if is_final and not number:
                self._learn(images, drawings, reach)
            edges = self.edges if is_final else self._rough_edges
            search = Search(edges, reach, spacing_px)
            rows = []
            for i, drawing in zip(images, drawings, strict=True):
                shown = Shown(i, frames[:, i], slopes[:, i], drawing)
                rows.append(self._rows(estimate, shown, search))
            equations = Equations(*map(np.concatenate, zip(*rows, strict=True)))
            fit = solved(estimate, equations, priors)
            estimate = fit.estimate
            if is_final and number > _FIRST_STEPS:
                priors = priors.of_this_arm(fit)
        assert fit, "there is at least one step"
        return fit

    def reach_m(self) -> float:
        """Radius of the space in which the links move, metres."""
        frames = self.views.body.frames(self.views.values)
        places = frames[self.moving, :, :3, 3].reshape(-1, 3)
        return float(np.linalg.norm(places - places.mean(0), axis=1).max())

    def start(self, camera_from_base: SE3) -> Estimate:
        """A start with the stated camera and joint values."""
        count = JOINTS + len(self.views.body.joints)
        return Estimate(camera_from_base, self.views.camera, np.zeros(count))

    def draw(self, estimate: Estimate, base_from_link: Array) -> IntArray:
        """Draw the arm with link poses (links, 4, 4)."""
        pose = estimate.camera_from_base.matrix()
        return self._rasterizer.draw(pose @ base_from_link, estimate.camera)

    def _learn(
        self, images: Sequence[int], drawings: Sequence[IntArray], reach: float
    ) -> None:
        covered = np.ones(self.views.images.shape[:3], bool)
        side = 2 * max(round(reach), 3) + 1
        for i, drawing in zip(images, drawings, strict=True):
            arm = (drawing >= 0).astype(np.uint8)
            covered[i] = cv2.dilate(arm, np.ones((side, side), np.uint8)) > 0
        self.views.learn_background(covered)

    def _rows(self, estimate: Estimate, shown: Shown, search: Search) -> Equations:
        """Residuals of one image."""
        camera = estimate.camera
        links = estimate.camera_from_base.matrix() @ shown.base_from_link
        points = outline_points(
            search.edges, links, camera, shown.drawing, search.spacing_px
        )
        points = points.at(self.moving[points.link])
        offsets = image_offsets(self.views, shown.number, points, search.reach_px)
        count = len(self.edges)
        testable = np.bincount(points.link[offsets.testable], minlength=count)
        testable = testable.astype(float)
        points = points.at(offsets.confirmed)
        px = offsets.px[offsets.confirmed]
        owner = np.full(len(px), shown.number)
        by_link = links[:, :3, :3] @ shown.slopes.reshape(count, 2, 3, -1).swapaxes(
            0, 1
        )
        slopes = outline_slopes(points, camera, links, by_link)
        return Equations(slopes, px, owner, points.link, testable[None])


def outline_slopes(
    points: OutlinePoints, camera: Camera, links: Array, by_joint: Array
) -> Array:
    """(m, 10 + k) motion along the normals of outlines by each parameter.

    `links` (links, 4, 4) are poses in the camera, and `by_joint` (2, links, 3, k) their translation
    and rotation by each joint value, in camera axes.
    """
    x, y, z = points.in_camera.T
    along = points.normals * [camera.fx, camera.fy]
    depth = -(along[:, 0] * x + along[:, 1] * y) / z
    by_point = np.stack([*along.T, depth], 1) / z[:, None]
    from_centre = points.pixels - [camera.cx, camera.cy]
    focal = (points.normals * from_centre).sum(1)
    shift, turn = by_joint[:, points.link]
    lever = points.in_camera - links[points.link, :3, 3]
    by_turn = np.cross(lever, by_point)
    return np.concatenate(
        [
            by_point,
            np.cross(points.in_camera, by_point),
            focal[:, None],
            points.normals,
            np.ones((len(z), 1)),
            np.einsum("mck,mc->mk", shift, by_point)
            + np.einsum("mck,mc->mk", turn, by_turn),
        ],
        1,
    )


def moving_links(views: ArmViews) -> BoolArray:
    """(links,) whether the motion of a link uncovers what is behind it."""
    frames = views.body.frames(views.values)
    moving = []
    for shape, poses in zip(views.body.links, frames, strict=True):
        corners = np.stack([shape.vertices.min(0), shape.vertices.max(0)])
        middle = corners.mean(0) @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, :3, 3]
        size = np.linalg.norm(np.ptp(corners, 0))
        moving.append(np.linalg.norm(np.ptp(middle, 0)) > _MOVES * size)
    return np.array(moving)
