"""Image pairs with known correspondences: pictures under homographies, rooms under parallax."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.random import Generator

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.simulation.box_room import BoxRoom, look_at
from evercal.simulation.textures import dead_leaves
from evercal.typing import Image

HEIGHT = 192
WIDTH = 256
PER_ANCHOR = 4
FIRST_ROOM_SEED = 1_000
"""First seed of pretraining rooms; tests and demos use lower seeds."""
END_ROOM_SEED = FIRST_ROOM_SEED + 3_000
"""Seeds from here to the held-out rooms are free for rooms of benchmarks."""
VALIDATION_ROOM_SEED = FIRST_ROOM_SEED + 7_000
"""First seed of held-out rooms."""


@dataclass(frozen=True)
class Pair:
    """Two grey images with corresponding pixels."""

    images: np.ndarray
    """(2, HEIGHT, WIDTH) uint8."""
    pixels: np.ndarray
    """(2, n, 2) float32 pixels (u, v); row k is one surface point in both images."""


def pinhole(focal: float) -> Camera:
    """Create a camera with a focal length in pixels and a central principal point."""
    return Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def cell_pixels() -> np.ndarray:
    """Return the centres (u, v) of the stride-8 cells, ((HEIGHT / 8) (WIDTH / 8), 2)."""
    v, u = np.mgrid[0 : HEIGHT // 8, 0 : WIDTH // 8]
    return np.stack([u, v], -1).reshape(-1, 2) * 8.0 + 3.5


def inside(pixels: np.ndarray, margin: float = 3.5) -> np.ndarray:
    """Return a mask (n,) of pixels at least `margin` from the border."""
    high = (WIDTH - 1 - margin, HEIGHT - 1 - margin)
    return np.asarray(((pixels >= margin) & (pixels <= high)).all(-1))


def room_seeds(count: int) -> range:
    """Seeds of pretraining rooms and pictures."""
    return range(FIRST_ROOM_SEED, FIRST_ROOM_SEED + count)


def random_homography(side: int, rng: Generator) -> np.ndarray:
    """Draw a (3, 3) homography from image pixels to pixels of a square picture."""
    scale = np.exp(rng.uniform(np.log(0.6), np.log(1.7)))
    angle = rng.normal(0, 0.3)
    c = np.cos(angle)
    s = np.sin(angle)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    corners = (2.0 * square - 1) * [WIDTH / 2, HEIGHT / 2] * scale
    corners = corners @ np.array([[c, s], [-s, c]])
    corners *= 1 + rng.uniform(-0.2, 0.2, (4, 2))
    corners += side / 2 + rng.uniform(-0.12, 0.12, 2) * side
    border = square * np.array([WIDTH - 1, HEIGHT - 1], np.float32)
    return cv2.getPerspectiveTransform(border, corners.astype(np.float32))


def homography_pair(picture: np.ndarray, rng: Generator) -> Pair:
    """Warp one grey (s, s) uint8 picture to two random perspective views."""
    maps = []
    images = []
    for _ in range(2):
        homography = random_homography(len(picture), rng)
        maps.append(homography)
        warped = cv2.warpPerspective(
            picture,
            homography,
            (WIDTH, HEIGHT),
            flags=cv2.INTER_AREA | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT,
        )
        images.append(warped)
    first = _random_pixels(rng)
    second = cv2.perspectiveTransform(first[None], np.linalg.inv(maps[1]) @ maps[0])[0]
    on_picture = cv2.perspectiveTransform(first[None], maps[0])[0]
    keep = inside(first) & inside(second)
    keep &= ((on_picture >= 0) & (on_picture < len(picture))).all(-1)
    pixels = np.stack([first[keep], second[keep]])
    return Pair(np.stack(images), pixels.astype(np.float32))


def _random_pixels(rng: Generator) -> np.ndarray:
    """One random pixel (u, v) of each cell, in the order of `cell_pixels`."""
    centres = cell_pixels()
    return centres + rng.uniform(-3.5, 3.5, centres.shape)


class Views(Protocol):
    """Views of one room; each group of `PER_ANCHOR` consecutive views shows the same part."""

    images: np.ndarray
    """(n, HEIGHT, WIDTH) uint8 grey."""
    base_from_camera: SE3
    """(n,) poses."""
    cameras: tuple[Camera, ...]
    """n pinhole cameras; the focal length differs between anchors."""

    def hit(self, view: int, pixels: np.ndarray) -> np.ndarray:
        """Return the (n, 3) surface points at (n, 2) pixels of a view; NaN without a surface."""
        ...

    def visible(self, view: int, points_m: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of points (n, 3) within the image that no surface occludes."""
        ...


@dataclass(eq=False)
class RoomViews:
    """`Views` of a box room."""

    images: np.ndarray
    base_from_camera: SE3
    cameras: tuple[Camera, ...]
    geometry: BoxRoom
    """The room without its textures, which would use much memory."""

    def hit(self, view: int, pixels: np.ndarray) -> np.ndarray:
        """Intersect rays with surfaces; see `Views`."""
        pose = self.base_from_camera[view]
        rays = self.cameras[view].unproject(pixels) @ pose.rotation_matrix().T
        return self.geometry.intersect(pose.translation_m, rays)[0]

    def visible(self, view: int, points_m: np.ndarray) -> np.ndarray:
        """Test for occlusion; see `Views`."""
        eye = self.base_from_camera[view].translation_m
        _, depth = self.geometry.intersect(eye, points_m - eye)
        return np.abs(depth - 1.0) < 0.01  # 1: the first hit is the point itself


def room_views(seed: int, anchors: int = 5, per_anchor: int = PER_ANCHOR) -> RoomViews:
    """Render a room from `anchors * per_anchor` cameras with different parallax, scale, roll."""
    rng = np.random.default_rng([seed, 77])
    room = BoxRoom(seed, texture_px=256)
    poses = []
    cameras = []
    images = []
    for _ in range(anchors):
        camera = pinhole(rng.uniform(0.65, 1.15) * WIDTH)
        anchor = room.random_view(rng)
        axis = anchor.rotation_matrix()[:, 2]
        _, depth = room.intersect(anchor.translation_m, axis[None])
        target = anchor.translation_m + axis * min(float(depth[0]), 6.0)
        for k in range(per_anchor):
            eye = anchor.translation_m + (k > 0) * rng.normal(0, [0.45, 0.45, 0.25])
            limit = room.size_m[:2] / 2 - 0.3
            eye[:2] = np.clip(eye[:2], -limit, limit)
            eye[2] = np.clip(eye[2], 0.3, room.size_m[2] - 0.2)
            aim = target + (k > 0) * rng.normal(0, 0.35, 3)
            pose = look_at(eye, aim, rng.normal(0, 0.15))
            poses.append(pose)
            cameras.append(camera)
            images.append(cv2.cvtColor(room.render(camera, pose), cv2.COLOR_RGB2GRAY))
    room.surfaces = [
        type(s)(s.corner_m, s.edge_u_m, s.edge_v_m, (s.pyramid[-1],))
        for s in room.surfaces
    ]
    return RoomViews(np.stack(images), SE3.stack(poses), tuple(cameras), room)


def view_pair(views: Views, first: int, second: int, rng: Generator) -> Pair:
    """Compute corresponding pixels of two views of a room, without occluded points."""
    pixels = _random_pixels(rng)
    points = views.hit(first, pixels)
    in_b = views.base_from_camera[second].inverse().apply(points)
    front = np.isfinite(in_b[:, 2]) & (in_b[:, 2] > 0.05)
    in_b[~front] = [0, 0, 1]
    projected = views.cameras[second].project(in_b)
    keep = np.flatnonzero(front & inside(pixels) & inside(projected))
    keep = keep[views.visible(second, points[keep])]
    images = views.images[[first, second]]
    return Pair(images, np.stack([pixels[keep], projected[keep]]).astype(np.float32))


def photometric(image: np.ndarray, rng: Generator) -> np.ndarray:
    """Change exposure, contrast, gamma, shading, blur and noise at random; uint8."""
    x = image.astype(np.float32) / 255.0
    if rng.random() < 0.35:
        sigma = rng.uniform(0.4, 1.4)
        x = cv2.GaussianBlur(x, (0, 0), sigma)
    if rng.random() < 0.25:  # motion blur
        length = int(rng.integers(3, 8))
        middle = length // 2  # an even kernel would shift the picture
        kernel = np.zeros((2 * middle + 1, 2 * middle + 1), np.float32)
        angle = rng.uniform(0, np.pi)
        half = (length - 1) / 2
        for step in np.linspace(-half, half, 2 * length):
            row = middle + step * np.sin(angle)
            column = middle + step * np.cos(angle)
            kernel[round(row), round(column)] = 1
        x = cv2.filter2D(x, -1, kernel / kernel.sum())
    x = np.clip(x, 0, 1) ** np.exp(rng.normal(0, 0.25))
    x = (x - 0.5) * np.exp(rng.normal(0, 0.2)) + 0.5 + rng.normal(0, 0.08)
    slope = rng.normal(0, 0.08, 2)
    v, u = np.mgrid[-0.5 : 0.5 : x.shape[0] * 1j, -0.5 : 0.5 : x.shape[1] * 1j]
    x = x * (1 + slope[0] * v + slope[1] * u)
    x = x + rng.normal(0, rng.uniform(0.002, 0.03), x.shape)
    return (np.clip(x, 0, 1) * 255).astype(np.uint8)


def seeded_picture(seed: int) -> Image:
    """Draw the dead-leaves picture of a seed."""
    return leaf_picture(np.random.default_rng([seed, 3]))


def leaf_picture(rng: Generator, side: int = 448) -> np.ndarray:
    """Draw a grey (side, side) uint8 dead-leaves picture."""
    return cv2.cvtColor(dead_leaves(side, side, rng), cv2.COLOR_RGB2GRAY)
