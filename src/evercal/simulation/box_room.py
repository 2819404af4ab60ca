"""Box rooms: textured rectangles with exact poses, rendered in milliseconds without extras.

A room is a box with furniture boxes and pictures on its walls. Every surface is a rectangle, so an
image is a set of perspective warps combined by depth, and rays intersect the room in closed form.
Base frame: origin on the floor in the middle of the room, z up, metres.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.random import Generator, default_rng

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.simulation.surfaces import (
    Pyramid,
    Surface,
    box_faces,
    draw,
    unit_vector,
)
from evercal.simulation.textures import dead_leaves, one_over_f
from evercal.typing import Array, ArrayPair, Image

_SMALLEST_PX = 16
"""Side of the smallest image of a texture pyramid, pixels."""


class BoxRoom:
    """A room generated from a seed; those from 9000 to 9999 are reserved for benchmarks."""

    def __init__(
        self,
        seed: int,
        furniture: int | None = None,
        texture_px: int = 384,
    ):
        rng = default_rng(seed)
        self.seed = seed
        self.size_m = rng.uniform((3.0, 3.0, 2.3), (5.5, 5.5, 3.0))
        self.texture_px = texture_px
        self.surfaces: list[Surface] = []
        x, y, _ = self.size_m
        low = np.array([-x / 2, -y / 2, 0])
        self.add_box(low, self.size_m, rng, inward=True)
        if furniture is None:
            furniture = int(rng.integers(5, 14))
        for _ in range(furniture):
            self._add_furniture(rng)
        for _ in range(rng.integers(4, 13)):
            self._add_picture(rng)

    def texture(self, rng: Generator, calm: bool) -> Pyramid:
        """A new texture with its halvings; a calm one shows less."""
        side = self.texture_px
        if calm:
            leaves = rng.integers(15, 80)
        else:
            leaves = rng.integers(20, 160)
        picture = dead_leaves(side, side, rng, int(leaves))
        light = cv2.resize(
            one_over_f(64, 2.0, rng),
            dsize=(side, side),
            interpolation=cv2.INTER_CUBIC,
        )
        brightness = rng.uniform(0.6, 1.0)
        shade = brightness * (1 + 0.12 * light)
        shaded = picture * np.clip(shade, 0.2, 1.3)[..., None]
        return _pyramid(np.clip(shaded, 0, 255).astype(np.uint8))

    def add_box(
        self,
        low: Array,
        size: Array,
        rng: Generator,
        inward: bool = False,
    ) -> None:
        """Add a textured box from its lowest corner (3,) and its sides (3,), see `box_faces`."""
        for corner, u, v in box_faces(low, np.diag(size), inward):
            calm = inward or rng.random() < 0.3
            pyramid = self.texture(rng, calm)
            self.surfaces.append(Surface(corner, u, v, pyramid))

    def _add_furniture(self, rng: Generator) -> None:
        """Add a box along a wall: the middle of the room stays free for cameras."""
        size = rng.uniform(0.2, (1.2, 1.2, 1.4))
        wall = rng.integers(4)
        free = self.size_m - size
        centre = rng.uniform(-0.5, 0.5, 2)
        centre *= free[:2]
        axis = wall // 2
        sign = 1 - 2 * (wall % 2)
        at_wall = sign * free[axis] / 2
        centre[axis] = at_wall * rng.uniform(0.85, 0.999)
        corner = centre - size[:2] / 2
        height = max(0.0, rng.uniform(-1.0, free[2]))
        self.add_box(np.append(corner, height), size, rng)

    def _add_picture(self, rng: Generator) -> None:
        wall = self.surfaces[rng.integers(4)]
        length_u = np.linalg.norm(wall.edge_u_m)
        length_v = np.linalg.norm(wall.edge_v_m)
        along_u = wall.edge_u_m / length_u
        along_v = wall.edge_v_m / length_v
        width, height = rng.uniform(0.3, 1.0, 2)
        right = max(length_u - width, 0.01)
        top = max(length_v - height, 0.31 * length_v)
        u = rng.uniform(0, right)
        v = rng.uniform(0.3 * length_v, top)
        in_wall = wall.corner_m + u * along_u + v * along_v
        picture = Surface(
            corner_m=in_wall + 0.01 * wall.normal,
            edge_u_m=along_u * width,
            edge_v_m=along_v * height,
            pyramid=self.texture(rng, calm=False),
        )
        self.surfaces.append(picture)

    def render(
        self,
        camera: Camera,
        base_from_camera: SE3,
        moving: Sequence[Surface] = (),
    ) -> Image:
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
            corner_m = camera_from_base.apply(surface.corner_m)
            edge_u = rotation @ surface.edge_u_m
            edge_v = rotation @ surface.edge_v_m
            edges = np.stack([edge_u, edge_v], -1)
            draw(
                image,
                nearness,
                surface.pyramid,
                corner_m,
                edges,
                camera,
            )
        return image

    def intersect(
        self,
        origin_m: Array,
        rays: Array,
    ) -> ArrayPair:
        """First intersections (n, 3) of rays, and their depths (n,) in units of the ray length.

        Origins (3,) or (n, 3) and directions (n, 3) of any length are in the base frame. Rays that
        miss have NaN and infinite depth.
        """
        origin = np.broadcast_to(origin_m, rays.shape)
        nearest = np.full(len(rays), np.inf)
        for surface in self.surfaces:
            depth = surface.depths(origin, rays)
            hit = depth < nearest
            nearest[hit] = depth[hit]
        depths = np.where(np.isfinite(nearest), nearest, np.nan)
        points = origin + depths[:, None] * rays
        return points, nearest

    def random_view(self, rng: Generator) -> SE3:
        """A random base_from_camera in the middle of the room, looking outwards, nearly upright."""
        half_x, half_y, _ = self.size_m / 2
        x, y = rng.uniform(-0.45, 0.45, 2)
        z = rng.uniform(0.5, 0.8 * self.size_m[2])
        position = np.array([x * half_x, y * half_y, z])
        heading = rng.uniform(0, 2 * np.pi)
        pitch = rng.uniform(-0.7, 0.3)
        target = position + _direction(heading, pitch)
        return look_at(position, target, rng.uniform(-0.25, 0.25))

    def path(self, frames: int, seed: int) -> SE3:
        """A smooth hand-held sweep once around the room, base_from_camera (frames,).

        The seed is that of the deviation from the room's common sweep, 10 to 20 cm and 10 deg.
        """
        common = default_rng([self.seed, 0])
        walker = default_rng([self.seed, seed])
        t = np.linspace(0, 2 * np.pi, frames, endpoint=False)

        def wave(
            low: float,
            high: float,
            deviation: float,
            cycles: int = 1,
        ) -> Array:
            phase = walker.uniform(0, 2 * np.pi)
            offset = walker.uniform(-1, 1)
            change = np.sin(3 * t + phase) + offset
            sweep = low + (high - low) * _wave(t, cycles, common)
            return sweep + 0.6 * deviation * change

        reach_x, reach_y, height = self.size_m * (0.12, 0.12, 0.75)
        x = wave(-reach_x, reach_x, deviation=0.15)
        y = wave(-reach_y, reach_y, deviation=0.15)
        z = wave(0.9, min(1.9, height), deviation=0.1)
        turn = wave(-0.6, 0.6, deviation=0.12, cycles=2)
        pitch = wave(-0.45, 0.15, deviation=0.05, cycles=2)
        roll = wave(-0.12, 0.12, deviation=0.05, cycles=2)
        eye = np.stack([x, y, z], -1)
        target = eye + _direction(t + turn, pitch)
        return SE3.stack(list(map(look_at, eye, target, roll)))


def _pyramid(picture: Image) -> Pyramid:
    pyramid = [picture]
    side = len(picture)
    while side > _SMALLEST_PX:
        # pyrDown centres pixel k on 2k instead of 2k + 0.5, which shifts the picture.
        side //= 2
        smaller = cv2.resize(
            pyramid[-1],
            dsize=(side, side),
            interpolation=cv2.INTER_AREA,
        )
        pyramid.append(smaller.astype(np.uint8))
    return tuple(pyramid)


def _wave(
    t: Array,
    cycles: int,
    rng: Generator,
) -> Array:
    """A random smooth function of angles (n,) with a period of 2 pi / cycles, in [0, 1]."""
    harmonics = []
    for number in (1, 2, 3):
        amplitude = rng.uniform(0.4, 1) / number
        phase = rng.uniform(0, 2 * np.pi)
        harmonics.append((number * cycles, amplitude, phase))

    def total(angles: Array) -> Array:
        values = np.zeros_like(angles)
        for frequency, amplitude, phase in harmonics:
            values += amplitude * np.sin(frequency * angles + phase)
        return values

    period = total(np.linspace(0, 2 * np.pi, 720))
    lowest = period.min()
    return (total(t) - lowest) / np.ptp(period)


def _direction(heading: Array | float, pitch: Array | float) -> Array:
    """Viewing directions (..., 3) whose horizontal part is a unit vector."""
    x = np.cos(heading)
    y = np.sin(heading)
    return np.stack([x, y, pitch], -1)


def look_at(
    position_m: Array,
    target_m: Array,
    roll_rad: float = 0.0,
) -> SE3:
    """base_from_camera of a camera at `position_m` that looks at `target_m`, with base z up."""
    forward = unit_vector(target_m - position_m)
    right = unit_vector(np.cross(forward, [0.0, 0.0, 1.0]))
    down = np.cross(forward, right)
    c = np.cos(roll_rad)
    s = np.sin(roll_rad)
    matrix = np.eye(4)
    matrix[:3, 0] = c * right + s * down
    matrix[:3, 1] = c * down - s * right
    matrix[:3, 2] = forward
    matrix[:3, 3] = position_m
    return SE3.from_matrix(matrix)


def default_camera(width: int = 320, height: int = 240) -> Camera:
    """A pinhole with a 63 deg field of view, as in common indoor data sets."""
    focal = 525.0 / 640.0 * max(width, height)
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
    )
