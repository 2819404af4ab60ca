"""The pose of a camera by the outlines of an arm: robust Gauss-Newton, drawn anew in each step.

Beside the pose it estimates what all images share and may be wrong, each with a prior: focal
length, principal point, a common shift of all outlines outwards, and offsets of the joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np

from evercal.calibration.arm_in_view.outline import (
    LinkEdges,
    OutlinePoints,
    image_offsets,
    link_edges,
    outline_points,
)
from evercal.calibration.arm_in_view.rasterizer import Drawing, Rasterizer
from evercal.calibration.arm_in_view.views import ArmViews
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.typing import Array, BoolArray, IntArray

POSE = slice(0, 6)
FOCAL = 6
CENTRE = slice(7, 9)
LENS = slice(6, 9)
OUTLINE = 9
JOINTS = 10
"""Columns of the parameters; one for each joint value from `JOINTS` on."""
LEAST_SCALE_PX = 0.3
"""Least robust standard deviation of the residuals."""
LEAST_REPEATS = 2.0
"""Least number of neighbouring residuals that err alike."""
_ROUGH = 0.004
"""Cells in which vertices are merged where only the place of links counts, in reaches."""
_LONGEST_STEP = 0.3
"""Metres or radians."""


@frozen_arrays
class Priors:
    """Standard deviations of the parameters before the images."""

    focal: float = 0.005
    """Of the logarithm of the focal length."""
    centre_px: float = 1.0
    """Of the principal point."""
    outline_px: float = 0.25
    """Of a common shift of all outlines: light, blur, simplified meshes."""
    usual: Array = field(default_factory=lambda: np.zeros(0))
    """(k,) of the offsets of joint values; 0 of those that are not estimated."""
    size: float = 1.0
    """Size of the offsets of this arm, in usual ones."""
    lens_is_free: bool = False
    """Whether focal length and principal point are estimated. If not, their errors count all the
    same: a right lens is known better than an arm tells it."""
    pose_only: bool = False
    """Whether nothing but the pose is estimated."""

    def sigma(self) -> Array:
        """(10 + k,) of all parameters; infinite of the pose."""
        pose = np.full(6, np.inf)
        shared = [self.focal, self.centre_px, self.centre_px, self.outline_px]
        return np.concatenate([pose, shared, self.size * self.usual])

    def free(self) -> BoolArray:
        """(10 + k,) whether a parameter is estimated."""
        free = self.sigma() > 0
        free[LENS] &= self.lens_is_free
        free[POSE.stop :] &= not self.pose_only
        return free

    def of_this_arm(self, fit: "ArmFit") -> Self:
        """With joint offsets of the size that they have in a fit.

        The size is estimated as by D. MacKay, Bayesian interpolation, 1992; the usual one counts as
        one joint.
        """
        offsets = self.usual > 0
        variance = np.zeros(len(fit.free))
        variance[fit.free] = np.diag(np.linalg.inv(fit.normal()))
        squares = fit.estimate.parameters**2 + variance
        ratios = squares[JOINTS:][offsets] / self.usual[offsets] ** 2
        size = np.sqrt((1 + ratios.sum()) / (1 + len(ratios)))
        return replace(self, size=float(size))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pose of a camera, and what all images share."""

    camera_from_base: SE3
    camera: Camera
    parameters: Array
    """(10 + k,) their changes since the start; those of the pose are 0."""

    @property
    def offsets(self) -> Array:
        """(k,) to be added to joint values."""
        return self.parameters[JOINTS:]

    def moved(self, step: Array) -> "Estimate":
        """After a step (10 + k,)."""
        pose = step[POSE]
        longest = np.abs(pose).max()
        pose = pose * min(1.0, _LONGEST_STEP / max(longest, 1e-12))
        change = step.copy()
        change[POSE] = 0
        camera = self.camera.changed(change[LENS]).pinhole
        camera_from_base = SE3.exp(pose) @ self.camera_from_base
        return Estimate(
            camera_from_base,
            camera,
            self.parameters + change,
        )


class Equations(NamedTuple):
    """Residuals of outlines by the parameters: (m,) rows of several images."""

    slopes: Array
    """(m, 10 + k)."""
    px: Array
    """(m,)."""
    image: IntArray
    """(m,)."""
    link: IntArray
    """(m,)."""
    testable: Array
    """(n, links) number of points whose background is known."""


@frozen_arrays
class ArmFit:
    """Result of a fit."""

    estimate: Estimate
    equations: Equations
    weights: Array
    """(m,) robust weights, 0 to 1."""
    scale_px: float
    """Robust standard deviation of the residuals."""
    repeats: float
    """Number of neighbouring residuals that err alike: their information counts once."""
    free: BoolArray
    """(10 + k,) whether a parameter is estimated."""
    priors: Priors

    def information(self) -> Array:
        """(10 + k, 10 + k) of the residuals."""
        weights = self.weights / (self.scale_px**2 * self.repeats)
        slopes = self.equations.slopes
        return (slopes * weights[:, None]).T @ slopes

    def normal(self, free: BoolArray | None = None) -> Array:
        """(p, p) normal matrix of free parameters, with priors."""
        free = self.free if free is None else free
        precision = 1 / self.priors.sigma()[free] ** 2
        return self.information()[np.ix_(free, free)] + np.diag(precision)

    def gradients(self) -> Array:
        """(m, 10 + k) of the residuals."""
        weights = self.weights * self.equations.px / (self.scale_px**2 * self.repeats)
        return self.equations.slopes * weights[:, None]

    def step(self, free: BoolArray, rows: BoolArray | None = None) -> Array:
        """(10 + k,) of the free parameters, by all residuals or some of them."""
        right = self.gradients()
        right = right.sum(0) if rows is None else 2 * right[rows].sum(0)
        precision = 1 / self.priors.sigma()[free] ** 2
        step = np.zeros(len(free))
        spent = precision * self.estimate.parameters[free]
        step[free] = np.linalg.solve(self.normal(free), right[free] - spent)
        return step

    def scatter(self, free: BoolArray) -> Array:
        """(p, p) covariance of the sum of gradients: clusters of images, and of links."""
        gradients = self.gradients()[:, free]
        by_image = _of_clusters(gradients, self.equations.image)
        return by_image + _of_clusters(gradients, self.equations.link)

    @property
    def confirmed(self) -> float:
        """Share of the outline that the images show, 0 to 1."""
        return float(self.weights.sum() / max(self.equations.testable.sum(), 1))


class Shown(NamedTuple):
    """The arm in one image."""

    number: int
    """Of the image."""
    base_from_link: Array
    """(links, 4, 4)."""
    slopes: Array
    """(links, 6, k) see `RobotBody.slopes`."""
    drawing: Drawing


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
        self._edges = [*map(link_edges, shapes)]
        self._rough_edges = [*map(link_edges, rough)]

    def fit(
        self,
        start: Estimate,
        priors: Priors,
        images: Sequence[int],
        reaches_px: Sequence[float],
        spacing_px: float,
        learn_at: Sequence[int] = (),
    ) -> ArmFit:
        """Fit the outlines of images.

        In the steps of `learn_at` the background is learned again; after them, the size of joint
        offsets is estimated.
        """
        estimate = start
        fit = None
        for number, reach in enumerate(reaches_px):
            values = self.views.values + estimate.offsets
            frames = self.views.body.frames(values)
            slopes = self.views.body.slopes(values)
            drawings = [self.draw(estimate, frames[:, i]) for i in images]
            if number in learn_at:
                self._learn(
                    images,
                    drawings,
                    reach,
                )
            edges = self._edges if learn_at else self._rough_edges
            search = Search(
                edges,
                reach,
                spacing_px,
            )
            rows = []
            for i, drawing in zip(
                images,
                drawings,
                strict=True,
            ):
                shown = Shown(
                    i,
                    frames[:, i],
                    slopes[:, i],
                    drawing,
                )
                rows.append(
                    self._rows(
                        estimate,
                        shown,
                        search,
                    )
                )
            equations = Equations(*map(np.concatenate, zip(*rows, strict=True)))
            fit = solved(
                estimate,
                equations,
                priors,
            )
            estimate = fit.estimate
            if learn_at and number >= max(learn_at):
                priors = priors.of_this_arm(fit)
        assert fit, "there is at least one step"
        return fit

    def reach_m(self) -> float:
        """Radius of the space in which the links move, metres."""
        frames = self.views.body.frames(self.views.values)
        places = frames[self.moving, :, :3, 3].reshape(-1, 3)
        if not len(places):
            return 0.0
        return float(np.linalg.norm(places - places.mean(0), axis=1).max())

    def start(self, camera_from_base: SE3) -> Estimate:
        """A start with the stated camera and joint values."""
        count = JOINTS + len(self.views.body.joints)
        return Estimate(
            camera_from_base,
            self.views.camera,
            np.zeros(count),
        )

    def draw(self, estimate: Estimate, base_from_link: Array) -> Drawing:
        """Draw the arm with link poses (links, 4, 4)."""
        pose = estimate.camera_from_base.matrix()
        return self._rasterizer.draw(pose @ base_from_link, estimate.camera)

    def _learn(
        self, images: Sequence[int], drawings: Sequence[Drawing], reach: float
    ) -> None:
        import cv2

        covered = np.ones(self.views.images.shape[:3], bool)
        side = 2 * max(round(reach), 3) + 1
        for i, drawing in zip(
            images,
            drawings,
            strict=True,
        ):
            arm = (drawing.links >= 0).astype(np.uint8)
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
        offsets = image_offsets(
            self.views,
            shown.number,
            points,
            search.reach_px,
        )
        count = len(self._edges)
        testable = np.bincount(points.link[offsets.testable], minlength=count)
        testable = testable.astype(float)
        points = points.at(offsets.confirmed)
        px = offsets.px[offsets.confirmed]
        owner = np.full(len(px), shown.number)
        by_link = links[:, :3, :3] @ shown.slopes.reshape(
            count,
            2,
            3,
            -1,
        ).swapaxes(0, 1)
        slopes = outline_slopes(
            points,
            camera,
            links,
            by_link,
        )
        return Equations(
            slopes,
            px,
            owner,
            points.link,
            testable[None],
        )


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
            np.einsum(
                "mck,mc->mk",
                shift,
                by_point,
            )
            + np.einsum(
                "mck,mc->mk",
                turn,
                by_turn,
            ),
        ],
        1,
    )


def moving_links(views: ArmViews) -> BoolArray:
    """(links,) whether the motion of a link uncovers what is behind it."""
    frames = views.body.frames(views.values)
    moving = []
    for shape, poses in zip(
        views.body.links,
        frames,
        strict=True,
    ):
        corners = np.stack([shape.vertices.min(0), shape.vertices.max(0)])
        middle = corners.mean(0) @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, :3, 3]
        size = np.linalg.norm(np.ptp(corners, 0))
        moving.append(np.linalg.norm(np.ptp(middle, 0)) > _MOVES * size)
    return np.array(moving)


_MOVES = 0.3
"""Least way of the middle of a link that moves, in its sizes."""


def solved(estimate: Estimate, equations: Equations, priors: Priors) -> ArmFit:
    """One robust Gauss-Newton step."""
    free = priors.free()
    px = equations.px
    if len(px) < 2 * free.sum():
        raise TooFewPoints
    scale = max(LEAST_SCALE_PX, 1.4826 * float(np.median(np.abs(px))))
    weights = 1 / (1 + (px / (2 * scale)) ** 2) ** 2
    fit = ArmFit(
        estimate,
        equations,
        weights,
        scale,
        1.0,
        free,
        priors,
    )
    information = fit.information()[np.ix_(free, free)]
    scatter = fit.scatter(free)
    ridge = 1e-9 * np.diag(np.diag(information))
    repeats = np.trace(np.linalg.solve(information + ridge, scatter)) / len(scatter)
    fit = replace(fit, repeats=max(LEAST_REPEATS, float(repeats)))
    return replace(fit, estimate=estimate.moved(fit.step(free)))


def _of_clusters(gradients: Array, owners: IntArray) -> Array:
    _, number = np.unique(owners, return_inverse=True)
    sums = np.zeros((number.max() + 1, gradients.shape[1]))
    np.add.at(
        sums,
        number,
        gradients,
    )
    sums -= sums.mean(0)
    return sums.T @ sums * len(sums) / max(len(sums) - 1, 1)


class TooFewPoints(ValueError):
    """The images show too little of the outline."""
