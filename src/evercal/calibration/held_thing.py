"""What a fixed camera sees of a thing that the gripper holds: everything that moves with it.

A pixel that shows the same patch in other images, up to gain and offset, stands still. The rest is
the thing, the arm, and people. Matches that agree with the gripper's motion locate the thing; a
window around it makes a thing of a few pixels as large as the encoder needs.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from evercal.calibration.hand_eye_start import (
    HandEyeStart,
    ImagePair,
    scene_from_parent,
)
from evercal.geometry import SE3
from evercal.recordings.frame import Frame
from evercal.recordings.masks import without
from evercal.typing import Array, BoolArray, IntArray

PATCH_PX, SAME, STILL_IN, LEAST_CONTRAST = 9, 0.8, 2, 2.0
"""Side of a patch; correlation of equal patches; other images that show a patch where it stands
still; least variance of a patch that shows something, in variances of the noise."""
COMPARED = 40
"""Images that each one is compared with, about."""
LEAST_NOISE = 2.0
"""Standard deviation of intensities that every camera has at least."""
LONG_SIDE = 640
"""Images are compared at this size, pixels."""
MARGIN = 1.2
"""Side of the window around a thing, as a factor."""
MOST_WINDOW = 0.75
"""Windows larger than this share of the image are not worth it."""


def moving_parts(frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], float]:
    """The frames without what stands still, and the share of their texture that stands still."""
    images = [frame.read_image() for frame in frames]
    scale = min(1.0, LONG_SIDE / max(images[0].shape[:2]))
    greys = [
        cv2.resize(
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY),
            None,
            None,
            scale,
            scale,
            cv2.INTER_AREA,
        )
        for image in images
    ]
    still, textured = _still(greys)
    share = float((still & textured).sum() / max(textured.sum(), 1))
    return tuple(
        replace(frame, image=without(image, _opened(~stands & visible)))
        for frame, image, stands, visible in zip(
            frames, images, still, textured, strict=True
        )
    ), share


def _still(
    greys: Sequence[NDArray[Any]],
) -> tuple[BoolArray, BoolArray]:
    """(n, h, w) whether a patch is repeated at its place, and whether it shows anything."""
    size = (PATCH_PX, PATCH_PX)
    images = [grey.astype(np.float32) for grey in greys]
    means = [cv2.blur(image, size) for image in images]
    variances = np.stack(
        [
            np.maximum(cv2.blur(i * i, size) - m * m, 0)
            for i, m in zip(images, means, strict=True)
        ]
    )
    # Most of two images is equal but for the noise.
    changes = [
        float(np.median(cv2.blur((b - a) ** 2, size) - cv2.blur(b - a, size) ** 2)) / 2
        for a, b in itertools.pairwise(images)
    ]
    noise = max(float(np.median(changes)), LEAST_NOISE**2)
    signals = np.maximum(variances - noise, noise)
    apart = -(-len(images) // COMPARED)
    repeated = np.zeros(variances.shape, np.int16)
    for i, image in enumerate(images):
        for j in range(i % apart, i, apart):
            covariance = cv2.blur(image * images[j], size) - means[i] * means[j]
            same = covariance > SAME * np.sqrt(signals[i] * signals[j])
            repeated[i] += same
            repeated[j] += same
    return repeated >= STILL_IN, variances > (1 + LEAST_CONTRAST) * noise


def _opened(moving: BoolArray) -> BoolArray:
    """Without single pixels."""
    return (
        cv2.morphologyEx(
            moving.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
        )
        > 0
    )


def windows(frames: Sequence[Frame], start: HandEyeStart) -> IntArray | None:
    """(n, 3) left, top and side of a window around the thing; None if it fills the images."""
    poses = scene_from_parent(frames, "eye_to_hand") @ start.parent_from_camera
    points = _points(poses, start.matches)
    if not len(points):
        return None
    inner = np.abs(points - np.median(points, 0))
    points = points[(inner < 4 * np.median(inner, 0) + 1e-6).all(1)]
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
    corner = np.clip(np.rint((low + high - side) / 2), 0, size - side).astype(np.int64)
    return np.c_[corner, np.full(len(corner), side)]


def cropped(frame: Frame, window: IntArray) -> Frame:
    """The part of a frame in a window."""
    left, top, side = window.tolist()
    camera = frame.camera
    image = frame.read_image()[top : top + side, left : left + side]
    part = replace(
        camera, width=side, height=side, cx=camera.cx - left, cy=camera.cy - top
    )
    return replace(frame, image=np.ascontiguousarray(image), camera=part)


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
        along = (bb * (a @ between) - ab * (b @ between)) / np.maximum(
            aa * bb - ab**2, 1e-9
        )
        points.append(first[:3, 3] + a * along[:, None])
    return np.concatenate(points)
