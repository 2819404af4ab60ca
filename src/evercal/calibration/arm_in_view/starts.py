"""First poses of a camera from masks of what moves: a grid of directions, ranked by overlap."""

from collections.abc import Iterator
from itertools import product

import cv2
import numpy as np

from evercal.calibration.arm_in_view.views import ArmViews
from evercal.geometry import SE3, Camera, norms, spread, unit_vectors
from evercal.typing import Array, BoolArray, Float32Array, Image, IntArray

WIDTH_PX = 80
"""Long side of the masks."""
_AZIMUTHS = 24
_ELEVATIONS_DEG = (-20, 0, 20, 40, 60, 80)
_ROLLS_DEG = (0, 90, 180, 270)
_DISTANCES = (0.6, 0.9, 1.4, 2.0, 2.8, 4.0)
"""In reaches of the arm."""
_NEAREST = 0.25
"""Nearest point of the arm, in reaches."""
_DRAWN = (600, 150)
"""Starts that are drawn in few images, and in more images."""
_IMAGES = (4, 10)
"""Number of these images."""
_DIRECTIONS = unit_vectors(
    np.array([*product((-1.0, 0.0, 1.0), repeat=3)]) + 1e-3 * np.eye(3)[0]
)
_SHIFT = 4
_PARTS = 2**_SHIFT
"""Parts of a pixel in which OpenCV draws."""
_RETURNED = 12
"""Starts that are returned."""


class Overlap:
    """Compares masks with convex hulls of the links."""

    def __init__(self, views: ArmViews, moving: BoolArray) -> None:
        scale = WIDTH_PX / max(views.camera.size)
        self.masks = views.masks(scale)
        height, width = self.masks.shape[1:]
        self.camera = views.camera.resized(width, height)
        self.frames = views.body.frames(views.values)[moving]
        chosen = [views.body.links[k].vertices for k in np.flatnonzero(moving)]
        self.corners = np.stack([*map(_corners, chosen)])

    def score(self, camera_from_base: Array, images: IntArray) -> float:
        """Twice the common area over the sum of both, 0 to 1."""
        common = 0.0
        total = 0.0
        for i in images:
            arm = self._arm(camera_from_base @ self.frames[:, i])
            common += float(self.masks[i][arm > 0].sum())
            total += float(arm.sum() + self.masks[i].sum())
        return 2 * common / max(total, 1.0)

    def _arm(self, camera_from_link: Array) -> Image:
        arm = np.zeros(self.masks.shape[1:], np.uint8)
        rotation = camera_from_link[:, :3, :3].swapaxes(1, 2)
        points = self.corners @ rotation + camera_from_link[:, None, :3, 3]
        pixels = self.camera.project(points)
        for outline in pixels[np.isfinite(pixels).all((1, 2))]:
            hull = cv2.convexHull(outline.astype(np.float32))
            parts = np.rint(hull * _PARTS).astype(np.int32)
            cv2.fillConvexPoly(
                arm,
                parts,
                1,
                shift=_SHIFT,
            )
        return arm


def _corners(vertices: Array) -> Array:
    """(m, 3) the farthest vertices in directions all around, nearly the convex hull."""
    farthest = (vertices @ _DIRECTIONS.T).argmax(0)
    return vertices[farthest]


def starts(overlap: Overlap, reach_m: float) -> list[SE3]:
    """camera_from_base of starts, the best first."""
    enough = overlap.masks.sum((1, 2))
    images = np.flatnonzero(enough > 0.3 * np.median(enough))
    candidates = _grid(
        overlap,
        images,
        reach_m,
    )
    poses = [pose for _, pose in sorted(candidates, key=lambda item: item[0])]
    for most, number in zip(
        _DRAWN,
        _IMAGES,
        strict=True,
    ):
        some = images[spread(len(images), number)]
        scored = [(overlap.score(pose, some), pose) for pose in poses[:most]]
        scored.sort(key=lambda item: -item[0])
        poses = [pose for _, pose in scored]
    return [SE3.from_matrix(pose) for pose in poses[:_RETURNED]]


def _grid(
    overlap: Overlap, images: IntArray, reach_m: float
) -> Iterator[tuple[float, Array]]:
    """Poses whose arm is near the middle of the masks, with the distance that is left."""
    masks = overlap.masks[images]
    rays = _middles(masks, overlap.camera)
    # The position of the arm in each image: the mean of its links.
    frames = overlap.frames[:, images]
    centres = overlap.corners.mean(1)[:, None, :, None]
    places = (frames[..., :3, :3] @ centres)[..., 0] + frames[..., :3, 3]
    middle = places.mean(0)
    for rotation in _rotations():
        mean = middle @ rotation.T
        for distance in _DISTANCES:
            depth = mean[:, 2] - mean[:, 2].mean() + distance * reach_m
            if depth.min() < _NEAREST * reach_m:
                continue
            across = np.median(rays * depth[:, None] - mean[:, :2], 0)
            pose = np.eye(4)
            pose[:3, :3] = rotation
            pose[:3, 3] = [*across, distance * reach_m - mean[:, 2].mean()]
            left = rays - (mean[:, :2] + across) / depth[:, None]
            yield float(np.median(norms(left))), pose


def _middles(masks: Float32Array, camera: Camera) -> Array:
    """(n, 2) of the plane z = 1: the centroids of masks."""
    height, width = masks.shape[1:]
    area = np.maximum(masks.sum((1, 2)), 1e-6)
    x = (masks.sum(1) @ np.arange(width)) / area
    y = (masks.sum(2) @ np.arange(height)) / area
    return camera.unproject(np.stack([x, y], 1))[:, :2]


def _rotations() -> Iterator[Array]:
    """camera_from_base of cameras that look at the arm."""
    azimuths = np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS
    elevations = np.deg2rad(_ELEVATIONS_DEG)
    rolls = np.deg2rad(_ROLLS_DEG)
    for azimuth, elevation, roll in product(
        azimuths,
        elevations,
        rolls,
    ):
        flat = np.cos(elevation)
        towards = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
        forward = -np.array(towards)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        down = np.cross(forward, right)
        turned = np.cos(roll) * right + np.sin(roll) * down
        yield np.stack([turned, np.cross(forward, turned), forward])
