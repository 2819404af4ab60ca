"""Cells of an arm before two fixed cameras, drawn by OpenCV before a painted room."""

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.robot.link_shapes import RobotBody
from evercal.simulation.box_room import look_at

CLIPS = 3
"""Motions in each cell."""
STEPS = 36
"""Images of a clip."""
FPS = 15
LOW = np.array([-1.2, -0.6, -0.8, -2.6, -1.2, 1.0, -1.5])
"""Least drawn joint values, radians."""
HIGH = np.array([1.2, 0.9, 0.8, -1.2, 1.2, 2.8, 1.5])
_URDF = "share/example-robot-data/robots/panda_description/urdf/panda.urdf"


def panda() -> Path:
    """URDF of the Panda in the package `example-robot-data`."""
    for entry in sys.path:
        file = Path(entry) / "cmeel.prefix" / _URDF
        if file.is_file():
            return file
    raise InputError("the arm needs the package example-robot-data; install it")


@dataclass(frozen=True)
class Options:
    """Size of a data set."""

    episodes: int = 300
    width: int = 320
    """Of the images, pixels; the height is 9/16 of it."""
    seed: int = 0


class Cell:
    """Two cameras, a painted room, and motions of the arm."""

    def __init__(self, number: int, options: Options, body: RobotBody) -> None:
        self.rng = np.random.default_rng([options.seed, number])
        width = options.width
        focal = 0.42 * width
        height = width * 9 // 16
        centre = ((width - 1) / 2, (height - 1) / 2)
        self.camera = Camera(width, height, focal, focal, *centre)
        self.body = body
        self.places = [self._place(side) for side in (1, -1)]
        self.moved = [place @ _bump(self.rng) for place in self.places]
        self.clips = [self._motion() for _ in range(CLIPS)]
        self._walls = [_painted(self.rng, 2 * width, 2 * height) for _ in range(4)]
        self._light = self.rng.normal((0, 0, 2))

    def _place(self, side: int) -> SE3:
        azimuth = side * self.rng.uniform(0.6, 1.5)
        away = self.rng.uniform(0.85, 1.3)
        x, y = away * np.cos(azimuth), away * np.sin(azimuth)
        at = np.array([0.35 + x, y, self.rng.uniform(0.35, 0.8)])
        middle = np.array([0.35, 0.0, 0.35]) + self.rng.uniform(-0.05, 0.05, 3)
        return look_at(at, middle)

    def _motion(self) -> np.ndarray:
        """(STEPS, 7) joint values with rests."""
        places = self.rng.uniform(LOW, HIGH, (6, 7))
        times = np.linspace(0, len(places) - 1, STEPS)
        before = np.minimum(times.astype(int), len(places) - 2)
        part = (times - before)[:, None]
        smooth = part**3 * (10 - 15 * part + 6 * part**2)
        return places[before] * (1 - smooth) + places[before + 1] * smooth

    def image(self, view: int, moved: bool, clip: int, step: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""
        place = (self.moved if moved else self.places)[view]
        frames = self.body.frames(self.clips[clip][step : step + 1])[:, 0]
        wall = self._walls[2 * moved + view]
        image = _drawn(self.body, frames, place, self.camera, wall, self._light)
        image = cv2.resize(image, None, None, 0.5, 0.5, cv2.INTER_AREA)
        noise = self.rng.normal(0, 2.5, image.shape)
        return np.clip(255 * image + noise, 0, 255).astype(np.uint8)


def _bump(rng: np.random.Generator) -> SE3:
    shift = rng.normal(size=3)
    turn = rng.normal(size=3)
    shift *= rng.uniform(0.04, 0.12) / np.linalg.norm(shift)
    turn *= rng.uniform(0.03, 0.12) / np.linalg.norm(turn)
    return SE3.exp(np.concatenate([shift, turn]))


def _painted(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A background of shades, things with straight edges and texture, 0 to 1."""
    image = np.zeros((height, width, 3), np.float32)
    shades = rng.uniform(0.25, 0.8, (2, 1)) + rng.uniform(-0.06, 0.06, (2, 3))
    top, bottom = shades
    ramp = np.linspace(0, 1, height)[:, None, None]
    image[:] = top + (bottom - top) * ramp
    for _ in range(30):
        centre = rng.uniform(0, 1, 2) * [width, height]
        size = rng.uniform(0.02, 0.25, 2) * width
        box = cv2.boxPoints((centre.tolist(), size.tolist(), float(rng.uniform(0, 90))))
        grey = rng.uniform(0.05, 0.85)
        colour = np.clip(grey + rng.uniform(-0.12, 0.12, 3), 0, 1).tolist()
        cv2.fillConvexPoly(image, box.astype(np.int32), colour, cv2.LINE_AA)
    texture = np.zeros((height, width), np.float32)
    for octave in (4, 16, 64):
        coarse = rng.normal(0, 0.04, (height // octave + 2, width // octave + 2))
        texture += cv2.resize(coarse.astype(np.float32), (width, height))
    return np.clip(image + texture[..., None], 0, 1)


def _drawn(
    body: RobotBody,
    frames: np.ndarray,
    place: SE3,
    camera: Camera,
    wall: np.ndarray,
    light: np.ndarray,
) -> np.ndarray:
    """The arm before a wall, at twice the size of the camera's images."""
    towards = place.inverse().matrix()
    points, colours = [], []
    for shape, frame in zip(body.links, frames, strict=True):
        corners = shape.vertices[shape.faces] @ frame[:3, :3].T + frame[:3, 3]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        shade = 0.45 + 0.5 * np.clip(normal @ light / np.linalg.norm(light), -0.6, 1)
        tone = 0.25 if "hand" in shape.link or "finger" in shape.link else 0.95
        points.append(corners.reshape(-1, 3) @ towards[:3, :3].T + towards[:3, 3])
        colours.append(np.repeat(tone * shade, 3))
    at = np.concatenate(points) * [1, -1, -1]
    grey = np.repeat(np.concatenate(colours)[:, None], 3, 1).astype(np.float32)
    faces = np.arange(len(at), dtype=np.int32).reshape(-1, 3)
    image = wall.copy()
    depth = np.full(image.shape[:2], 50, np.float32)
    settings = cv2.TriangleRasterizeSettings()
    settings = settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    settings = settings.setShadingType(cv2.RASTERIZE_SHADING_FLAT)
    field = 2 * np.arctan(camera.height / 2 / camera.fy)
    cv2.triangleRasterize(
        at.astype(np.float32),
        faces,
        grey,
        image,
        depth,
        np.eye(4),
        field,
        0.05,
        50.0,
        settings,
    )
    return image


def write_video(path: Path, images: Iterable[np.ndarray]) -> None:
    """Write images as H.264."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = None
        for image in images:
            if stream is None:
                options = {"crf": "20", "preset": "veryfast", "g": "8"}
                stream = container.add_stream("libx264", rate=FPS, options=options)
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
