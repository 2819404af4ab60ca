"""Box rooms: textured rectangles with exact poses, rendered in milliseconds without extras.

A room is a box with furniture boxes and pictures on its walls. Every surface is a rectangle, so an
image is a set of perspective warps combined by depth, and rays intersect the room in closed form.
Base frame: origin on the floor in the middle of the room, z up, metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.simulation.textures import dead_leaves, one_over_f

NEAR_M = 0.05


@dataclass(frozen=True)
class Surface:
    """One textured rectangle in the base frame, visible from the side of its normal."""

    corner_m: np.ndarray
    """(3,) corner of texture pixel (0, 0)."""
    edge_u_m: np.ndarray
    """(3,) along texture columns."""
    edge_v_m: np.ndarray
    """(3,) along texture rows."""
    pyramid: tuple[np.ndarray, ...]
    """Texture (h, w, 3) uint8 and its halvings, against aliasing."""

    @cached_property
    def normal(self) -> np.ndarray:
        """Unit normal, shape (3,)."""
        cross = np.cross(self.edge_u_m, self.edge_v_m)
        return cross / np.linalg.norm(cross)


class BoxRoom:
    """A room generated from a seed; those from 9000 to 9999 are reserved for benchmarks."""

    def __init__(self, seed: int, furniture: int | None = None, texture_px: int = 384):
        rng = np.random.default_rng(seed)
        self.seed = seed
        self.size_m = np.array(
            [rng.uniform(3.0, 5.5), rng.uniform(3.0, 5.5), rng.uniform(2.3, 3)]
        )
        self.texture_px = texture_px
        self.surfaces: list[Surface] = []
        x, y, _ = self.size_m
        self.add_box(np.array([-x / 2, -y / 2, 0]), self.size_m, rng, inward=True)
        for _ in range(int(rng.integers(5, 14)) if furniture is None else furniture):
            size = np.array(
                [rng.uniform(0.2, 1.2), rng.uniform(0.2, 1.2), rng.uniform(0.2, 1.4)]
            )
            # Along the walls: the middle of the room stays free for cameras.
            side = rng.integers(4)
            centre = rng.uniform(-0.5, 0.5, 2) * (self.size_m[:2] - size[:2])
            axis = side // 2
            sign = 1 - 2 * (side % 2)
            centre[axis] = (
                sign * (self.size_m[axis] - size[axis]) / 2 * rng.uniform(0.85, 0.999)
            )
            height = max(0.0, rng.uniform(-1.0, self.size_m[2] - size[2]))
            self.add_box(
                np.array([*(centre - size[:2] / 2), height]), size, rng, inward=False
            )
        for _ in range(int(rng.integers(4, 13))):
            self._add_picture(rng)

    def texture(self, rng: np.random.Generator, calm: bool) -> tuple[np.ndarray, ...]:
        """A new texture with its halvings; a calm one shows less."""
        import cv2

        side = self.texture_px
        leaves = int(rng.integers(15, 80)) if calm else int(rng.integers(20, 160))
        picture = dead_leaves(side, side, rng, leaves)
        light = one_over_f(64, 2.0, rng)
        light = cv2.resize(light, (side, side), interpolation=cv2.INTER_CUBIC)
        shade = np.clip(rng.uniform(0.6, 1.0) * (1 + 0.12 * light), 0.2, 1.3)[..., None]
        picture = np.clip(picture * shade, 0, 255).astype(np.uint8)
        pyramid = [picture]
        while pyramid[-1].shape[0] > 16:
            # pyrDown centres pixel k on 2k instead of 2k + 0.5, which shifts the picture.
            half = pyramid[-1].shape[0] // 2
            smaller = cv2.resize(
                pyramid[-1], (half, half), interpolation=cv2.INTER_AREA
            )
            pyramid.append(smaller.astype(np.uint8))
        return tuple(pyramid)

    def add_box(
        self,
        low: np.ndarray,
        size: np.ndarray,
        rng: np.random.Generator,
        inward: bool = False,
    ) -> None:
        """Add a textured box from its lowest corner (3,) and its sides (3,), see `box_faces`."""
        for corner, u, v in box_faces(low, np.diag(size), inward):
            pyramid = self.texture(rng, calm=inward or rng.random() < 0.3)
            self.surfaces.append(Surface(corner, u, v, pyramid))

    def _add_picture(self, rng: np.random.Generator) -> None:
        wall = self.surfaces[int(rng.integers(4))]
        length_u = np.linalg.norm(wall.edge_u_m)
        length_v = np.linalg.norm(wall.edge_v_m)
        size = rng.uniform(0.3, 1.0, 2)
        u = rng.uniform(0, max(length_u - size[0], 0.01))
        v = rng.uniform(0.3 * length_v, max(length_v - size[1], 0.31 * length_v))
        unit_u = wall.edge_u_m / length_u
        unit_v = wall.edge_v_m / length_v
        corner = wall.corner_m + u * unit_u + v * unit_v + 0.01 * wall.normal
        pyramid = self.texture(rng, calm=False)
        self.surfaces.append(
            Surface(corner, unit_u * size[0], unit_v * size[1], pyramid)
        )

    def render(
        self, camera: Camera, base_from_camera: SE3, moving: Sequence[Surface] = ()
    ) -> np.ndarray:
        """Render an image of an ideal pinhole camera; `moving` surfaces are for this image."""
        if camera.distortion:
            raise ValueError(
                "box rooms are rendered through an ideal pinhole, without distortion"
            )
        image = np.zeros((camera.height, camera.width, 3), np.uint8)
        nearness = np.zeros((camera.height, camera.width), np.float32)  # 1 / depth
        camera_from_base = base_from_camera.inverse()
        rotation = camera_from_base.rotation_matrix()
        for surface in (*self.surfaces, *moving):
            corner = camera_from_base.apply(surface.corner_m)
            edges = np.stack(
                [rotation @ surface.edge_u_m, rotation @ surface.edge_v_m], -1
            )
            _draw(image, nearness, surface.pyramid, corner, edges, camera)
        return image

    def intersect(
        self, origin_m: np.ndarray, rays: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """First intersections (n, 3) of rays, and their depths (n,) in units of the ray length.

        Origins (3,) or (n, 3) and directions (n, 3) of any length are in the base frame. Rays that
        miss have NaN and infinite depth.
        """
        origin = np.broadcast_to(origin_m, rays.shape)
        best = np.full(len(rays), np.inf)
        for surface in self.surfaces:
            slope = rays @ surface.normal
            with np.errstate(divide="ignore", invalid="ignore"):
                depth = ((surface.corner_m - origin) @ surface.normal) / slope
                local = origin + depth[:, None] * rays - surface.corner_m
                u = local @ surface.edge_u_m / (surface.edge_u_m @ surface.edge_u_m)
                v = local @ surface.edge_v_m / (surface.edge_v_m @ surface.edge_v_m)
                hit = (slope < 0) & (depth > 1e-6) & (depth < best)
                hit &= (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
            best[hit] = depth[hit]
        points = origin + np.where(np.isfinite(best), best, np.nan)[:, None] * rays
        return points, best

    def random_view(self, rng: np.random.Generator) -> SE3:
        """A random base_from_camera in the middle of the room, looking outwards, nearly upright."""
        half = self.size_m / 2
        centre = rng.uniform(-0.45, 0.45, 2) * half[:2]
        position = np.array([*centre, rng.uniform(0.5, 0.8 * self.size_m[2])])
        heading = rng.uniform(0, 2 * np.pi)
        target = np.array([np.cos(heading), np.sin(heading), rng.uniform(-0.7, 0.3)])
        return look_at(position, position + target, rng.uniform(-0.25, 0.25))

    def path(self, frames: int, seed: int) -> SE3:
        """A smooth hand-held sweep once around the room, base_from_camera (frames,).

        The seed is that of the deviation from the room's common sweep, 10 to 20 cm and 10 deg.
        """
        common = np.random.default_rng([self.seed, 0])
        walker = np.random.default_rng([self.seed, seed])
        t = np.linspace(0, 2 * np.pi, frames, endpoint=False)
        half = self.size_m / 2

        def wave(low: float, high: float, cycles: int, deviation: float) -> np.ndarray:
            change = np.sin(3 * t + walker.uniform(0, 2 * np.pi)) + walker.uniform(
                -1, 1
            )
            return (
                low + (high - low) * _wave(t, cycles, common) + 0.6 * deviation * change
            )

        x = wave(-0.24 * half[0], 0.24 * half[0], 1, 0.15)
        y = wave(-0.24 * half[1], 0.24 * half[1], 1, 0.15)
        z = wave(0.9, min(1.9, 0.75 * self.size_m[2]), 1, 0.1)
        heading = t + wave(-0.6, 0.6, 2, 0.12)
        pitch = wave(-0.45, 0.15, 2, 0.05)
        roll = wave(-0.12, 0.12, 2, 0.05)
        eye = np.stack([x, y, z], -1)
        target = eye + np.stack([np.cos(heading), np.sin(heading), pitch], -1)
        return SE3.stack([look_at(eye[i], target[i], roll[i]) for i in range(frames)])


def box_faces(
    low: np.ndarray, edges: np.ndarray, inward: bool = False
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Corner and two edges, shape (3,), of each visible face of a box: all but its bottom.

    The edges (3, 3), one a row, start at `low`, are right-handed and orthogonal; the last one
    points up. `inward` is a box that is seen from inside, with its floor.
    """
    ex, ey, ez = edges
    faces = [
        (low, ex, ez),
        (low + ey + ex, -ex, ez),
        (low + ex, ey, ez),
        (low + ey, -ey, ez),
    ]
    faces.append((low + ez, ex, ey))
    if inward:
        faces.append((low + ey, ex, -ey))
        faces = [(corner + u, -u, v) for corner, u, v in faces]
    return faces


def _wave(t: np.ndarray, cycles: int, rng: np.random.Generator) -> np.ndarray:
    parts = [(k, rng.uniform(0.4, 1) / k, rng.uniform(0, 2 * np.pi)) for k in (1, 2, 3)]

    def total(x: np.ndarray) -> np.ndarray:
        return sum(
            (a * np.sin(k * cycles * x + p) for k, a, p in parts), np.zeros_like(x)
        )

    whole = total(np.linspace(0, 2 * np.pi, 720))
    return (total(t) - whole.min()) / np.ptp(whole)


def look_at(position_m: np.ndarray, target_m: np.ndarray, roll_rad: float = 0.0) -> SE3:
    """base_from_camera of a camera at `position_m` that looks at `target_m`, with base z up."""
    forward = target_m - position_m
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    c = np.cos(roll_rad)
    s = np.sin(roll_rad)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([c * right + s * down, c * down - s * right, forward], -1)
    matrix[:3, 3] = position_m
    return SE3.from_matrix(matrix)


def default_camera(width: int = 320, height: int = 240) -> Camera:
    """A pinhole with a 63 deg field of view, as in common indoor data sets."""
    focal = 525.0 / 640.0 * max(width, height)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _draw(
    image: np.ndarray,
    nearness: np.ndarray,
    pyramid: tuple[np.ndarray, ...],
    corner: np.ndarray,
    edges: np.ndarray,
    camera: Camera,
) -> None:
    """Warp a rectangle in camera coordinates into `image` where it is nearest, by `nearness`."""
    import cv2

    normal = np.cross(edges[:, 0], edges[:, 1])
    if normal @ corner >= 0:  # back side
        return
    corners = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ edges.T
    if corners[:, 2].max() < NEAR_M:
        return
    left = 0
    top = 0
    right = camera.width
    bottom = camera.height
    if corners[:, 2].min() > NEAR_M:
        pixels = camera.project(corners)
        left, top = np.maximum(np.floor(pixels.min(0)).astype(int), 0)
        right = min(int(np.ceil(pixels[:, 0].max())) + 1, camera.width)
        bottom = min(int(np.ceil(pixels[:, 1].max())) + 1, camera.height)
        if left >= right or top >= bottom:
            return
    # image ~ K [edges | corner] (u, v, 1): its inverse gives texture coordinates and 1 / depth.
    image_from_texture = camera.matrix() @ np.column_stack([edges, corner])
    texture_from_image = np.linalg.inv(image_from_texture)
    v, u = np.mgrid[top:bottom, left:right].astype(np.float32)
    a, b, w = (
        (row[0] * u + row[1] * v + row[2]).astype(np.float32)
        for row in texture_from_image
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        s = a / w
        t = b / w
        front = nearness[top:bottom, left:right]
        visible = (
            (w > front) & (w < 1 / NEAR_M) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        )
    if not visible.any():
        return
    # The pyramid level follows from texture pixels per image pixel over the visible area.
    span = (
        np.ptp(s[visible])
        * np.ptp(t[visible])
        * pyramid[0].shape[0] ** 2
        / visible.sum()
    )
    level = int(np.clip(np.round(0.5 * np.log2(max(span, 1.0))), 0, len(pyramid) - 1))
    texture = pyramid[level]
    height, width = texture.shape[:2]
    warped = cv2.remap(
        texture,
        np.where(visible, s * width - 0.5, 0).astype(np.float32),
        np.where(visible, t * height - 0.5, 0).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    np.copyto(image[top:bottom, left:right], warped, where=visible[..., None])
    np.copyto(front, w, where=visible)
