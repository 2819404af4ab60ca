"""Do poses of the colour camera suit the images of 7-Scenes better than the published ones?"""

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from benchmarks.rows import Row, save
from evercal.geometry import Camera
from evercal.recordings import Frame, ReadOptions, load_recording

LEAST_MATCHES = 30
"""Smallest number of matches of a pair that counts."""


def run(
    scenes: tuple[Path, ...],
    apart: tuple[int, ...] = (5, 10, 20),
    pairs: int = 120,
    out: Path = Path("runs/depth-poses"),
) -> int:
    """Measure distances of matches from the epipolar lines of the stated poses.

    Args:
        scenes: Folders of 7-Scenes.
        apart: Numbers of frames from the first to the second image of a pair.
        pairs: Pairs of a scene, drawn from the training frames.
        out: Folder for the rows.
    """
    rows: list[Row] = []
    for scene in scenes:
        original = load_recording(scene)
        colour = load_recording(scene, options=ReadOptions(poses="colour"))
        converted = {frame.name: frame for frame in colour.train}
        for step in apart:
            medians = []
            for first, second in _pairs(original.train, step, pairs):
                matches = _matches(first, second)
                if len(matches) < LEAST_MATCHES:
                    continue
                others = converted[first.name], converted[second.name]
                medians.append(
                    [
                        np.median(sampson_px(first, second, matches)),
                        np.median(sampson_px(*others, matches)),
                    ]
                )
            middle = np.median(medians, axis=0)
            rows.append(
                {
                    "scene": scene.name,
                    "frames_apart": step,
                    "pairs": len(medians),
                    "original_px": float(middle[0]),
                    "colour_px": float(middle[1]),
                }
            )
    save(out / "depth_poses.csv", rows)
    return 0


def _pairs(
    frames: tuple[Frame, ...], step: int, count: int
) -> Iterator[tuple[Frame, Frame]]:
    """Frames of one sequence whose numbers differ by `step`."""
    found = []
    for _, sequence in groupby(frames, key=lambda frame: frame.name.split("/")[0]):
        by_name = {frame.name: frame for frame in sequence}
        for name, frame in by_name.items():
            stem, _, number = name.rpartition("-")
            other = by_name.get(f"{stem}-{int(number) + step:06d}")
            if other:
                found.append((frame, other))
    order = np.random.default_rng(0).permutation(len(found))
    yield from (found[i] for i in order[:count])


def _matches(first: Frame, second: Frame) -> np.ndarray:
    """(n, 2, 2) pixels in both images, by SIFT and a fundamental matrix of their own."""
    sift = cv2.SIFT.create(1500)
    points, descriptors = [], []
    for frame in (first, second):
        grey = cv2.cvtColor(frame.read_image(), cv2.COLOR_RGB2GRAY)
        keypoints, values = sift.detectAndCompute(grey, None)
        if values is None:
            return np.zeros((0, 2, 2))
        points.append([keypoint.pt for keypoint in keypoints])
        descriptors.append(values)
    kept = []
    for best, *more in cv2.BFMatcher().knnMatch(*descriptors, k=2):
        if more and best.distance < 0.7 * more[0].distance:
            kept.append([points[0][best.queryIdx], points[1][best.trainIdx]])
    pixels = np.array(kept).reshape(-1, 2, 2)
    if len(pixels) < LEAST_MATCHES:
        return pixels
    _, mask = cv2.findFundamentalMat(
        pixels[:, 0], pixels[:, 1], cv2.FM_RANSAC, 1.5, 0.999
    )
    return pixels[np.ravel(mask) > 0]


def sampson_px(first: Frame, second: Frame, pixels: np.ndarray) -> np.ndarray:
    """(n,) first-order distances of matches from the epipolar geometry of two stated poses."""
    assert first.base_from_camera
    assert second.base_from_camera
    relative = second.base_from_camera.inverse() @ first.base_from_camera
    cross = np.cross(np.eye(3), relative.translation_m)  # its sign is free
    essential = cross @ relative.rotation_matrix()
    left = _inverse(second.camera).T
    fundamental = left @ essential @ _inverse(first.camera)
    homogeneous = np.insert(pixels, 2, 1.0, axis=2)
    line = homogeneous[:, 0] @ fundamental.T
    other = homogeneous[:, 1] @ fundamental
    error = np.sum(homogeneous[:, 1] * line, axis=1)
    slope = np.hypot(*line[:, :2].T) ** 2 + np.hypot(*other[:, :2].T) ** 2
    return np.abs(error) / np.sqrt(slope)


def _inverse(camera: Camera) -> np.ndarray:
    return np.linalg.inv(camera.matrix())
