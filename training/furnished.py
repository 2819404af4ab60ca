"""Path-traced views of furnished rooms with true depth, for pretraining (folder `rooms`)."""

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.simulation.box_room import look_at
from evercal.simulation.panda_arm import HOME_RAD
from evercal.storage import write_bytes
from evercal.storage.settings import lock_settings
from rooms.panda import panda_meshes
from rooms.paths import is_clear
from rooms.renderer import Renderer, RenderOptions
from rooms.room import KINDS, Room, room
from training.pairs import HEIGHT, PER_ANCHOR, WIDTH, pinhole

SAMPLES = 8
OCCLUSION = 0.02
"""Relative depth difference beyond which a point is occluded."""


@dataclass(eq=False)
class FurnishedViews:
    """`Views` of a furnished room, with surfaces from depth maps."""

    images: np.ndarray
    base_from_camera: SE3
    cameras: tuple[Camera, ...]
    depth_m: np.ndarray
    """(n, HEIGHT, WIDTH) float16 metres along the optical axis; 0 without a surface."""

    def _depth(self, view: int, pixels: np.ndarray) -> np.ndarray:
        u, v = np.rint(pixels).astype(int).T
        return self.depth_m[view, v, u].astype(float)

    def hit(self, view: int, pixels: np.ndarray) -> np.ndarray:
        """Intersect rays with surfaces; see `Views`."""
        depth = self._depth(view, pixels)
        depth[depth == 0] = np.nan
        points = self.cameras[view].unproject(pixels) * depth[:, None]
        return self.base_from_camera[view].apply(points)

    def visible(self, view: int, points_m: np.ndarray) -> np.ndarray:
        """Test for occlusion; see `Views`."""
        within = self.base_from_camera[view].inverse().apply(points_m)
        depth = self._depth(view, self.cameras[view].project(within))
        return np.abs(depth - within[:, 2]) < OCCLUSION * within[:, 2]


def furnished_views(seed: int, anchors: int = 5) -> FurnishedViews:
    """Render a furnished room from `anchors * PER_ANCHOR` cameras.

    Cameras have random positions in free space, 0.7 to 3 m from a piece of furniture. The views of
    an anchor differ by parallax, scale and roll. Seeds start at FIRST_ROOM_SEED.
    """
    import cv2

    rng = np.random.default_rng([seed, 78])
    scene = room(sorted(KINDS)[seed % len(KINDS)], seed)
    joints = HOME_RAD + rng.normal(0, 0.3, 7)
    renderer = Renderer(scene.meshes() + panda_meshes(joints), rng.uniform(1.2, 2.8))
    poses = []
    cameras = []
    images = []
    depths = []
    for _ in range(anchors):
        camera = pinhole(rng.uniform(0.65, 1.15) * WIDTH)
        for pose in _anchor(scene, rng):
            image = renderer.render(
                camera, pose, RenderOptions(SAMPLES), int(rng.integers(2**31))
            )
            poses.append(pose)
            cameras.append(camera)
            images.append(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            depths.append(renderer.depth(camera, pose).astype(np.float16))
    return FurnishedViews(
        np.stack(images), SE3.stack(poses), tuple(cameras), np.stack(depths)
    )


def _anchor(scene: Room, rng: np.random.Generator) -> Iterator[SE3]:
    """Yield PER_ANCHOR poses that view one item from nearby positions."""
    while True:
        bounds_m = scene.items[rng.integers(len(scene.items))].bounds_m()
        target = rng.uniform(bounds_m[0], bounds_m[1])
        direction = rng.standard_normal(3) * (1, 1, 0.6)
        eye = target + rng.uniform(0.7, 3.0) * direction / np.linalg.norm(direction)
        spread = 0.25 * float(np.linalg.norm(eye - target))
        eyes = eye + spread * rng.standard_normal((PER_ANCHOR, 3)) * (1, 1, 0.6)
        if eye[2] > scene.low_m[2] + 0.3 and is_clear(scene, eyes).all():
            break
    for eye in eyes:
        aim = target + 0.15 * rng.standard_normal(3)
        yield look_at(eye, aim, rng.normal(0, 0.15))


def cached_furnished_views(seed: int, folder: Path) -> FurnishedViews:
    """Read the views of a room from `folder`; render and write them if missing."""
    # Increase the version when the rooms or the renderer change.
    settings = {
        "version": 1,
        "samples": SAMPLES,
        "size": [WIDTH, HEIGHT],
        "per_anchor": PER_ANCHOR,
    }
    lock_settings(folder / "rooms.json", settings)
    path = folder / f"room-{seed}.npz"
    if not path.is_file():
        views = furnished_views(seed)
        buffer = io.BytesIO()
        focal = [camera.fx for camera in views.cameras]
        pose = views.base_from_camera
        np.savez_compressed(
            buffer,
            images=views.images,
            depth_m=views.depth_m,
            focal=focal,
            rotation_wxyz=pose.rotation_wxyz,
            translation_m=pose.translation_m,
        )
        write_bytes(path, buffer.getvalue())
    with np.load(path) as saved:
        cameras = tuple(pinhole(focal) for focal in saved["focal"].tolist())
        poses = SE3(saved["rotation_wxyz"], saved["translation_m"])
        return FurnishedViews(saved["images"], poses, cameras, saved["depth_m"])
