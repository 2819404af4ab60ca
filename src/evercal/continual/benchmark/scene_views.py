"""What methods see: a test image of every scene, and the scene as points for the pose they found.

    OUT/views/STRATEGY-SCENE.npz

Points are the depths of training frames where the recording has depths, else what the method itself
answers about training frames, which shows what it still knows. `evercal bench-report` draws them.
"""

import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, Camera, pose_distance
from evercal.localization.localizer import Localizer
from evercal.recordings import Frame, Recording, posed_frames
from evercal.storage import write_bytes

VIEWS = "views"
FRAMES = 24
DEPTH_STEP_PX = 4


@dataclass(frozen=True, eq=False)
class SceneView:
    """One test image and what one method made of it."""

    strategy: str
    """The method."""
    scene: str
    """Whose image it is."""
    frame: Frame
    """The image, its camera, pose and joint angles."""
    found: str | None
    """The scene in which the method put it; None without a pose."""
    pose: SE3 | None
    """base_from_camera there."""
    points_m: NDArray[np.float32]
    """(n, 3) of that scene, base frame."""
    grey: NDArray[np.uint8]
    """(n,) how bright they are."""

    @property
    def outcome(self) -> str:
        """In a few words."""
        truth = self.frame.base_from_camera
        if self.pose is None or truth is None:
            return "no pose"
        if self.found != self.scene:
            return f"in {self.found}"
        metres, radians = pose_distance(truth, self.pose)
        return f"{100 * metres:.1f} cm, {math.degrees(radians):.1f} deg"


def keep_views(out: Path, strategy: str, localizer: Localizer, scenes: Sequence[Recording]) -> None:
    """Writes the view of the middle test frame of every scene, unless it is there."""
    for scene in scenes:
        path = out / VIEWS / f"{strategy}-{scene.name}.npz"
        if path.exists():
            continue
        tests = posed_frames(scene.test)
        frame = tests[len(tests) // 2]
        estimate = localizer.localize(frame.read_image(), frame.camera)
        points, grey = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
        for other in scenes:
            if other.name == estimate.scene:
                points, grey = _points(localizer, other)
        about = {
            "strategy": strategy,
            "scene": scene.name,
            "frame": frame.name,
            "camera": frame.camera.to_dict(),
            "truth": _numbers(frame.base_from_camera),
            "joints_rad": frame.joints_rad,
            "found": estimate.scene,
            "pose": _numbers(estimate.base_from_camera),
        }
        data = io.BytesIO()
        np.savez_compressed(
            data, about=json.dumps(about), image=frame.read_image(), points=points, grey=grey
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data.getvalue())


def read_views(out: Path) -> list[SceneView]:
    """All views in a folder of results, by scene and strategy; none where there are none."""
    return [_read(path) for path in sorted((out / VIEWS).glob("*.npz"))]


def _read(path: Path) -> SceneView:
    with np.load(path) as stored:
        about = json.loads(str(stored["about"]))
        image, points, grey = stored["image"], stored["points"], stored["grey"]
    joints = about["joints_rad"]
    frame = Frame(
        about["frame"],
        image,
        Camera.from_dict(about["camera"]),
        _pose(about["truth"]),
        joints_rad=None if joints is None else tuple(joints),
    )
    pose = _pose(about["pose"])
    return SceneView(about["strategy"], about["scene"], frame, about["found"], pose, points, grey)


def _points(
    localizer: Localizer, scene: Recording
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points (n, 3) of a scene and their grey values (n,)."""
    train = posed_frames(scene.train)
    with_depth = [frame for frame in train if frame.depth is not None]
    frames = with_depth or train
    points, grey = [np.zeros((0, 3))], [np.zeros(0)]
    for number in np.linspace(0, len(frames) - 1, FRAMES).astype(int):
        frame = frames[number]
        image = frame.read_image()
        if with_depth:
            found, pixels = _measured(frame)
        else:
            answer = localizer.localize(image, frame.camera)
            if answer.scene != scene.name or answer.points_m is None or answer.pixels is None:
                continue
            found = answer.points_m
            size = min(image.shape[:2]) / localizer.maps.short_side
            pixels = (answer.pixels + 0.5) * size - 0.5
        x, y = np.clip(np.rint(pixels).astype(int), 0, np.array(image.shape[1::-1]) - 1).T
        points.append(found)
        grey.append(image.mean(2)[y, x])
    return np.concatenate(points).astype(np.float32), np.concatenate(grey).astype(np.uint8)


def _measured(frame: Frame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 3) points of a frame's depth image in the base frame, and (n, 2) their pixels."""
    import cv2

    assert frame.depth is not None
    assert frame.base_from_camera is not None
    depth = cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.shape != (frame.camera.height, frame.camera.width):
        return np.zeros((0, 3)), np.zeros((0, 2))
    v, u = (DEPTH_STEP_PX * i for i in np.nonzero(depth[::DEPTH_STEP_PX, ::DEPTH_STEP_PX]))
    pixels = np.stack([u, v], 1).astype(float)
    rays = frame.camera.unproject(pixels)
    known = np.isfinite(rays).all(1)
    points = frame.base_from_camera.apply(rays * depth[v, u, None] / 1000)
    return points[known], pixels[known]


def _numbers(pose: SE3 | None) -> list[list[float]] | None:
    return None if pose is None else [pose.rotation_wxyz.tolist(), pose.translation_m.tolist()]


def _pose(numbers: list[list[float]] | None) -> SE3 | None:
    return None if numbers is None else SE3(np.array(numbers[0]), np.array(numbers[1]))
