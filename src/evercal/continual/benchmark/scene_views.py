"""Views for the report: a test image of each scene, and the scene's points at the estimated pose.

    OUT/views/STRATEGY-SCENE.npz

Points come from the depth images of training frames or, without depth, from what the strategy
itself estimates for training frames. `evercal bench-report` draws them.
"""

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, Camera, pose_distance, resize_pixels
from evercal.localization.learned import LearnedLocalizer
from evercal.recordings import Frame, Recording, posed_frames
from evercal.storage import write_bytes

VIEWS = "views"
FRAMES = 24
"""Training frames that points are taken from."""
DEPTH_STEP_PX = 4
"""Every such row and column of a depth image gives a point."""


@dataclass(frozen=True, eq=False)
class SceneView:
    """One test image and the estimate of one strategy."""

    strategy: str
    """Name of the strategy."""
    scene: str
    """Scene of the image."""
    frame: Frame
    """Image, camera, true pose and joint angles."""
    found: str | None
    """Scene of the estimate; None without a pose."""
    pose: SE3 | None
    """Estimated base_from_camera."""
    points_m: NDArray[np.float32]
    """Points of the estimated scene in the base frame, shape (n, 3)."""
    grey: NDArray[np.uint8]
    """Brightness of the points, shape (n,)."""

    @property
    def outcome(self) -> str:
        """The error, the wrong scene, or that there is no pose."""
        truth = self.frame.base_from_camera
        if self.pose is None or truth is None:
            return "no pose"
        if self.found != self.scene:
            return f"in {self.found}"
        metres, radians = pose_distance(truth, self.pose)
        return f"{100 * metres:.1f} cm, {math.degrees(radians):.1f} deg"


def keep_views(
    out: Path, strategy: str, localizer: LearnedLocalizer, scenes: Sequence[Recording]
) -> None:
    """Write the view of every scene's middle test frame, unless the file exists."""
    for scene in scenes:
        path = out / VIEWS / f"{strategy}-{scene.name}.npz"
        if path.exists():
            continue
        tests = posed_frames(scene.test)
        frame = tests[len(tests) // 2]
        estimate = localizer.localize(frame.read_image(), frame.camera)
        points, grey = _points(localizer, [s for s in scenes if s.name == estimate.scene])
        header = {
            "strategy": strategy,
            "scene": scene.name,
            "frame": frame.name,
            "camera": frame.camera.to_dict(),
            "truth": _to_numbers(frame.base_from_camera),
            "joints_rad": frame.joints_rad,
            "found": estimate.scene,
            "pose": _to_numbers(estimate.base_from_camera),
        }
        data = io.BytesIO()
        np.savez_compressed(
            data, about=json.dumps(header), image=frame.read_image(), points=points, grey=grey
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data.getvalue())


def read_views(out: Path) -> list[SceneView]:
    """Read all views of a folder of results, sorted by strategy and scene."""
    return [_read(path) for path in sorted((out / VIEWS).glob("*.npz"))]


def _read(path: Path) -> SceneView:
    with np.load(path) as stored:
        header = json.loads(str(stored["about"]))
        image, points, grey = stored["image"], stored["points"], stored["grey"]
    joints = header["joints_rad"]
    return SceneView(
        strategy=header["strategy"],
        scene=header["scene"],
        frame=Frame(
            header["frame"],
            image,
            Camera.from_dict(header["camera"]),
            _to_pose(header["truth"]),
            joints_rad=None if joints is None else tuple(joints),
        ),
        found=header["found"],
        pose=_to_pose(header["pose"]),
        points_m=points,
        grey=grey,
    )


def _points(
    localizer: LearnedLocalizer, scenes: Sequence[Recording]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return points (n, 3) of scenes and their brightness (n,)."""
    points, grey = [np.zeros((0, 3))], [np.zeros(0)]
    for scene in scenes:
        train = posed_frames(scene.train)
        with_depth = [frame for frame in train if frame.depth is not None]
        frames = with_depth or train
        for i in np.linspace(0, len(frames) - 1, FRAMES).astype(int):
            frame, image = frames[i], frames[i].read_image()
            if with_depth:
                more, pixels = _from_depth(frame)
            else:
                more, pixels = _from_estimate(localizer, scene.name, frame, image)
            x, y = np.clip(np.rint(pixels).astype(int), 0, np.array(image.shape[1::-1]) - 1).T
            points.append(more)
            grey.append(image.mean(2)[y, x])
    return np.concatenate(points).astype(np.float32), np.concatenate(grey).astype(np.uint8)


def _from_estimate(
    localizer: LearnedLocalizer, scene: str, frame: Frame, image: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return inlier points (n, 3) of a frame in the base frame and their pixels (n, 2)."""
    estimate = localizer.localize(image, frame.camera)
    if estimate.scene != scene or estimate.points_m is None or estimate.pixels is None:
        return np.zeros((0, 3)), np.zeros((0, 2))
    scale = min(image.shape[:2]) / localizer.contents.short_side
    return estimate.points_m, resize_pixels(estimate.pixels, scale)


def _from_depth(frame: Frame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (n, 3) of a frame's depth image in the base frame and their pixels (n, 2)."""
    import cv2

    assert frame.depth is not None
    assert frame.base_from_camera is not None
    depth = cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.shape != (frame.camera.height, frame.camera.width):
        return np.zeros((0, 3)), np.zeros((0, 2))
    v, u = (DEPTH_STEP_PX * i for i in np.nonzero(depth[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]))
    pixels = np.stack([u, v], 1).astype(float)
    rays = frame.camera.unproject(pixels)
    valid = np.isfinite(rays).all(1)
    points = frame.base_from_camera.apply(rays * depth[v, u, None] / 1000)
    return points[valid], pixels[valid]


def _to_numbers(pose: SE3 | None) -> list[list[float]] | None:
    return None if pose is None else [pose.rotation_wxyz.tolist(), pose.translation_m.tolist()]


def _to_pose(numbers: list[list[float]] | None) -> SE3 | None:
    return None if numbers is None else SE3(np.array(numbers[0]), np.array(numbers[1]))
