"""What is drawn of a map, of cameras in space and of their uncertainty; in the base frame.

Landmarks and keyframes are shown as the map was adjusted. Answers differ from that frame by the
corrections of `mapping.map_frame`, usually about a millimetre.
"""

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Literal, NamedTuple, Self

import numpy as np
from scipy.spatial import KDTree

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, UncertainPose, norms
from evercal.mapping.landmarks import Landmarks
from evercal.mapping.scene_map import SceneMap
from evercal.reports.charts import Panel, Shape
from evercal.reports.overlay import colour_map
from evercal.typing import Array, Image, Size

ColourBy = Literal["image", "height", "uncertainty"]
Plane = tuple[int, int]

DRAWN_M = 0.05
"""Longest half axis of a drawn ellipsoid."""
_SCALES = (500, 200, 100, 50, 20, 10, 5, 2)
"""Factors that enlarge drawn ellipsoids."""
MOST_POINTS = 50_000
"""Landmarks that are shown of all scenes together; more are thinned out evenly."""
_MOST_PIXELS = 120_000
"""Pixels that are shown around the landmarks of a scene."""
_PATCH_PX = 11.0
"""Radius of the surface that is shown around a landmark, pixels of its keyframe."""
_STEP_PX = 2
"""Distance of the pixels that are shown."""
THUMBNAIL_PX = 160
"""Width of the image in a frustum."""
ABOVE: Plane = (0, 1)
"""The axes of the base that a view from above shows."""
CHI2_95 = 7.8147
"""Squared Mahalanobis distance of 95 % of three-dimensional errors."""
_CORNERS = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
"""Signs of the corners of an image, around it."""
_DRAWN_POINTS = 6000
"""Landmarks in a chart, at most."""


@frozen_arrays
class Frustum:
    """The view of a pinhole camera whose principal point is the centre of its image."""

    base_from_camera: SE3
    fov_rad: float
    """Vertical angle of view, radians."""
    aspect: float
    """Width of the view divided by its height."""

    @classmethod
    def of(cls, base_from_camera: SE3, camera: Camera) -> Self:
        """The view of a camera; its distortion and the offset of its centre are left out."""
        fov = 2 * np.arctan2(camera.height / 2, camera.fy)
        aspect = (camera.width / camera.fx) / (camera.height / camera.fy)
        return cls(base_from_camera, float(fov), float(aspect))

    def corners(self, depth_m: float) -> Array:
        """(4, 3) corners of the view at a depth, in the base frame, metres."""
        high = np.tan(self.fov_rad / 2)
        signs = np.array(_CORNERS)
        plane = signs * [high * self.aspect, high]
        rays = np.column_stack([plane, np.ones(4)])
        return self.base_from_camera.apply(depth_m * rays)


@frozen_arrays
class Ellipsoid:
    """The translation of a pose within one standard deviation."""

    centre_m: Array
    """(3,) in the base frame, metres."""
    axes_m: Array
    """(3,) standard deviations along the principal axes, metres, ascending."""
    rotation_wxyz: Array
    """(4,) from the principal axes to the base frame."""

    @classmethod
    def of(cls, pose: UncertainPose) -> Self:
        """The ellipsoid of the translation's covariance."""
        variance, axes = np.linalg.eigh(pose.covariance[:3, :3])
        axes[:, 2] *= np.sign(np.linalg.det(axes))  # a rotation, and no reflection
        matrix = np.eye(4)
        matrix[:3, :3] = axes
        rotation = SE3.from_matrix(matrix).rotation_wxyz
        return cls(pose.pose.translation_m, np.sqrt(np.maximum(variance, 0)), rotation)

    @property
    def sigmas_mm(self) -> str:
        """Standard deviations along the principal axes, the largest first."""
        return " / ".join(f"{1000 * axis:.2g}" for axis in self.axes_m[::-1])


def readable_scale(ellipsoids: list[Ellipsoid], drawn_m: float = DRAWN_M) -> int:
    """The largest round factor that draws the half axes of ellipsoids no longer than `drawn_m`.

    Without ellipsoids, that of a standard deviation of 1 mm.
    """
    lengths = [float(ellipsoid.axes_m[-1]) for ellipsoid in ellipsoids]
    longest = max(lengths, default=0.001)
    for scale in _SCALES:
        if scale * longest <= drawn_m:
            return scale
    return 1


@frozen_arrays
class Landmarks3D:
    """The landmarks of a scene."""

    points_m: Array
    """(n, 3) in the base frame, metres."""
    grey: Image
    """(n,) the pixel of its keyframe."""
    sigma_mm: Array
    """(n,) standard deviation along the viewing ray of its keyframe, millimetres."""

    @classmethod
    def of(cls, scene: SceneMap, most: int = MOST_POINTS) -> Self:
        """All landmarks, or `most` of them, drawn evenly from all keyframes."""
        keyframes = scene.keyframes
        scale = _scale(scene)
        points: list[Array] = [np.zeros((0, 3))]
        grey = [np.zeros(0, np.uint8)]
        sigma = [np.zeros(0)]
        for i, marks in enumerate(keyframes.landmarks):
            local = marks.surface(keyframes.cameras[i])[0]
            in_map = keyframes.base_from_camera[i].apply(local)
            points.append(scene.frame.points_to_base(in_map))
            column, row = np.round(marks.pixels).astype(int).T
            image = keyframes.grey(i)
            grey.append(image[row, column])
            # The error of a depth 1 / d is sigma / d^2; along the ray it is as much longer.
            distance = norms(local)
            along = distance * marks.sigma / marks.inverse_depth
            sigma.append(1000 * scale * along)
        joined = np.concatenate(points)
        finite = np.isfinite(joined).all(1)
        valid = np.flatnonzero(finite)
        if len(valid) > most:
            chosen = np.linspace(0, len(valid) - 1, most)
            valid = valid[chosen.round().astype(int)]
        pixels = np.concatenate(grey)[valid]
        return cls(joined[valid], pixels, np.concatenate(sigma)[valid])

    def __len__(self) -> int:
        return len(self.points_m)

    def colours(self, by: ColourBy) -> Image:
        """(n, 3) RGB: the pixel of the image, or viridis of the height or of the uncertainty."""
        if by == "image":
            return np.repeat(self.grey[:, None], 3, axis=1)
        if not len(self):
            return np.zeros((0, 3), np.uint8)
        values = np.log(np.maximum(self.sigma_mm, 1e-6))
        if by == "height":
            values = np.asarray(self.points_m[:, 2], float)
        low, high = np.percentile(values, [2, 98]).tolist()
        return colour_map(values, (low, high))


def surface(scene: SceneMap) -> Landmarks3D:
    """The pixels around landmarks as landmarks, on the planes of the slopes that were measured.

    Their `sigma_mm` is their distance from the next one.
    """
    patches = []
    for camera, marks in zip(
        scene.keyframes.cameras, scene.keyframes.landmarks, strict=True
    ):
        every = np.mgrid[: camera.height : _STEP_PX, : camera.width : _STEP_PX]
        pixels = np.reshape(every, (2, -1)).T[:, ::-1]
        distance, nearest = map(np.asarray, KDTree(marks.pixels).query(pixels))
        near = distance < _PATCH_PX
        own = marks.take(nearest[near])
        change = (own.slope * (pixels[near] - own.pixels)).sum(axis=1)
        change = np.maximum(change, -own.inverse_depth / 2)  # at most twice as far
        inverse = own.inverse_depth + change
        apart = inverse * _STEP_PX / camera.fx
        patches.append(Landmarks(pixels[near], inverse, own.slope, apart))
    keyframes = replace(scene.keyframes, landmarks=tuple(patches))
    return Landmarks3D.of(replace(scene, keyframes=keyframes), _MOST_PIXELS)


@frozen_arrays
class KeyframeView:
    """A keyframe of a scene."""

    scene: str
    number: int
    frustum: Frustum
    camera: Camera
    """Intrinsics at the size of `image`."""
    image: Image
    """(h, w, 3) RGB at working size."""
    depths_m: Array
    """(n,) depths of its landmarks along the optical axis."""


def keyframe_views(scene: SceneMap) -> list[KeyframeView]:
    """All keyframes of a scene, with poses among the landmarks as they are shown."""
    keyframes = scene.keyframes
    scale = _scale(scene)
    views = []
    for i, camera in enumerate(keyframes.cameras):
        pose = keyframes.base_from_camera[i]
        marks = keyframes.landmarks[i]
        if scene.frame.similarity:
            pose = scene.frame.similarity.pose(pose)
        image = np.repeat(keyframes.grey(i)[..., None], 3, axis=-1)
        frustum = Frustum.of(pose, camera)
        depths = scale / marks.inverse_depth
        views.append(
            KeyframeView(
                scene.name,
                i,
                frustum,
                camera,
                image,
                depths,
            )
        )
    return views


def _scale(scene: SceneMap) -> float:
    similarity = scene.frame.similarity
    if not similarity:
        return 1.0
    return similarity.scale


@frozen_arrays
class Surroundings:
    """Landmarks and keyframes of a map; lengths in its unit."""

    points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) landmarks."""
    grey: Image = field(default_factory=lambda: np.zeros(0, np.uint8))
    """(n,) their pixels."""
    keyframes: tuple[Frustum, ...] = ()
    """Views of the map."""

    @classmethod
    def of(cls, scene: object) -> Self:
        """The landmarks and keyframes of a map; none of other scenes."""
        if not isinstance(scene, SceneMap):
            return cls()
        marks = Landmarks3D.of(scene, _DRAWN_POINTS)
        views = tuple(view.frustum for view in keyframe_views(scene))
        return cls(np.asarray(marks.points_m, float), marks.grey, views)

    def bounds(self, others: Array) -> Array:
        """(2, 3) corners of a box around the keyframes, other points, and the landmarks near by."""
        eyes = [view.base_from_camera.translation_m for view in self.keyframes]
        centres = np.reshape(eyes, (-1, 3))
        points = np.concatenate([centres, others])
        low = points.min(0)
        high = points.max(0)
        reach = max(float((high - low).max()), 0.1)
        if len(self.points_m):  # few landmarks lie far behind a window
            nearest, farthest = np.percentile(self.points_m, [2, 98], axis=0)
            lowest = np.maximum(nearest, low - reach)
            highest = np.minimum(farthest, high + reach)
            low = np.minimum(low, lowest)
            high = np.maximum(high, highest)
        margin = 0.1 * reach
        return np.stack([low - margin, high + margin])


def ellipse(pose: UncertainPose, times: float, plane: Plane) -> Array:
    """(n, 2) outline in a plane of the ellipsoid that holds a position with 95 %, enlarged."""
    covariance = pose.covariance[np.ix_(plane, plane)]
    values, vectors = np.linalg.eigh(covariance)
    half_axes = times * np.sqrt(CHI2_95 * values.clip(0))
    angle = np.linspace(0.0, 2 * np.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = pose.pose.translation_m[list(plane)]
    return centre + circle * half_axes @ vectors.T


class Axes(NamedTuple):
    """The two axes of a view."""

    plane: Plane = ABOVE
    """Numbers of the axes of the frame."""
    frame: str = "base"
    """Name of the frame."""
    unit: str = "m"
    """Of both axes."""

    def label(self, axis: int) -> str:
        """What an axis shows."""
        return f"{'xyz'[axis]} of {self.frame[:24]} ({self.unit})"


def view_panel(
    size: Size,
    axes: Axes,
    around: Surroundings,
    shown: Array,
    view: Frustum | None,
    shapes: Sequence[Shape] = (),
) -> Panel:
    """Show a map, the axes of its frame, the view of a camera, and shapes.

    Points (n, 3) are `shown`. Both axes have one scale: where the points need less than the panel,
    more is shown.
    """
    plane = axes.plane
    bounds = around.bounds(shown)
    extent = float(np.ptp(bounds, axis=0).max())
    low, high = bounds[:, plane]
    scale = ((high - low) / size).max()
    half = np.array(size) * scale / 2
    limits = (low + high) / 2 + np.stack([-half, half])
    flat = around.points_m[:, plane]
    lower, upper = limits
    inside = ((flat > lower) & (flat < upper)).all(axis=1)
    shade = np.where(inside, around.grey // 52, -1)
    drawn = []
    for i in range(5):  # neither ink nor paper
        points = flat[shade == i]
        opacity = 0.65 - 0.12 * i
        drawn.append(
            Shape(
                "dots",
                points,
                "text",
                1.9,
                opacity,
            )
        )
    drawn += shapes
    for frustum in around.keyframes:
        outline = _edges(frustum, 0.04 * extent)
        drawn.append(Shape("line", outline[:, plane], "blue", 1.2))
    directions = np.eye(3)[:, None]
    ends = 0.08 * extent * np.insert(directions, 0, 0, axis=1)
    for line, ink in zip(ends, ("red", "green", "blue"), strict=True):
        drawn.append(Shape("line", line[:, plane], ink, 2.5))
    if view:
        outline = _edges(view, 0.08 * extent)
        drawn.append(Shape("line", outline[:, plane], "orange", 2.2))
    labels = (axes.label(plane[0]), axes.label(plane[1]))
    return Panel(size, limits, labels, drawn)


def _edges(view: Frustum, length_m: float) -> Array:
    """(11, 3) one line along all edges of a view."""
    a, b, c, d = view.corners(length_m)
    eye = view.base_from_camera.translation_m
    return np.array([eye, a, b, eye, c, d, eye, b, c, d, a])
