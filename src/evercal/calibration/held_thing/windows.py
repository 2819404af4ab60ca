"""Windows of images around what the gripper holds, which enlarge a thing of a few pixels."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evercal.calibration.from_map.hand_eye_start import HandEyeStart, scene_from_parent
from evercal.calibration.from_map.image_pairs import ImagePair
from evercal.geometry import SE3
from evercal.recordings.frame import Frame
from evercal.recordings.repeated_patches import PATCH_PX
from evercal.robot.mount import EYE_TO_HAND
from evercal.typing import Array, IntArray

MARGIN = 1.2
"""Side of a window, in sides of the thing."""
MOST_WINDOW = 0.75
"""Largest side of a window, in short sides of the image; larger ones are not worth it."""
STRAY = 4.0
"""Points farther from the median than this many median distances are outliers."""


def windows(frames: Sequence[Frame], start: HandEyeStart) -> IntArray | None:
    """(n, 3) left, top and side of a window around the thing; None if it fills the images."""
    poses = scene_from_parent(frames, EYE_TO_HAND) @ start.parent_from_camera
    points = _points(poses, start.matches)
    if not len(points):
        return None
    distance = np.abs(points - np.median(points, 0))
    is_near = distance < STRAY * np.median(distance, 0) + 1e-6
    points = points[is_near.all(1)]
    low = []
    high = []
    for frame, pose in zip(frames, poses, strict=True):
        pixels = frame.camera.project(pose.inverse().apply(points))
        low.append(np.nanquantile(pixels, 0.01, axis=0))
        high.append(np.nanquantile(pixels, 0.99, axis=0))
    size = np.array([frames[0].camera.width, frames[0].camera.height])
    low = np.clip(low, 0, size - 1)
    high = np.clip(high, 0, size - 1)
    side = int(MARGIN * np.max(high - low)) + 2 * PATCH_PX
    if not np.isfinite(low + high).all() or side > MOST_WINDOW * size.min():
        return None
    corner = np.rint((low + high - side) / 2)
    corner = np.clip(corner, 0, size - side).astype(np.int64)
    return np.c_[corner, np.full(len(corner), side)]


def cropped(frame: Frame, window: IntArray) -> Frame:
    """The part of a frame in a window."""
    left, top, side = window.tolist()
    camera = replace(
        frame.camera,
        width=side,
        height=side,
        cx=frame.camera.cx - left,
        cy=frame.camera.cy - top,
    )
    image = frame.read_image()[top : top + side, left : left + side]
    return replace(frame, image=np.ascontiguousarray(image), camera=camera)


def _points(poses: SE3, pairs: Sequence[ImagePair]) -> Array:
    """(m, 3) matches triangulated in the frame of the gripper."""
    matrices = poses.matrix()
    points = [np.zeros((0, 3))]
    for pair in pairs:
        first = matrices[pair.first]
        second = matrices[pair.second]
        a = pair.rays[0] @ first[:3, :3].T
        b = pair.rays[1] @ second[:3, :3].T
        between = second[:3, 3] - first[:3, 3]
        # Nearest points of two rays: a s - b t = between.
        aa = (a * a).sum(1)
        ab = (a * b).sum(1)
        bb = (b * b).sum(1)
        determinant = np.maximum(aa * bb - ab**2, 1e-9)
        numerator = bb * (a @ between) - ab * (b @ between)
        along = numerator / determinant
        points.append(first[:3, 3] + a * along[:, None])
    return np.concatenate(points)
