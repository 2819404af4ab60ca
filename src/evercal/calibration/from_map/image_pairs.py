"""Pairs of similar images with matched features, for a first hand-eye transform."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.features.encoder import Encoder
from evercal.features.sift import epipolar_rays, sift_features
from evercal.features.views import working_image
from evercal.features.vlad import similar_pairs
from evercal.geometry import Camera
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame, stated_grippers
from evercal.robot.mount import Mount
from evercal.typing import Array, Float32Array, Image

PARTNERS = 6
"""Number of most similar frames that each frame is matched to."""
MATCHING_SIDE = 480
"""Short side of the images whose features are matched, pixels, by default."""
ENCODED_SIDE = 240
"""Short side of the images that are encoded, pixels."""
LEAST_MOTION_PX = 2.0
"""Before a fixed camera, matches that move less are background."""


class ImagePair(NamedTuple):
    """Two images and their matches."""

    first: int
    second: int
    rays: Array
    """(2, n, 3) rays of the matches in both camera frames, at depth 1."""


def image_pairs(
    frames: Sequence[Frame],
    mount: Mount,
    encoder: Encoder,
    on_progress: OnProgress = lambda *_: None,
    side: int = MATCHING_SIDE,
) -> list[ImagePair]:
    """Similar frames with enough matches, without those of the background of a fixed camera.

    Features are matched in images whose shorter side has at most `side` pixels.
    """
    images: list[Image] = []
    cameras: list[Camera] = []
    features: list[Float32Array] = []
    least_motion_px = 0.0 if mount.moves else LEAST_MOTION_PX
    for frame in frames:
        image = frame.read_image()
        grey, camera = working_image(image, frame.camera, min(side, *image.shape[:2]))
        images.append(grey)
        cameras.append(camera)
        if mount.moves:
            encoded = encoder.encode(grey, ENCODED_SIDE)
            features.append(encoded.reshape(-1, encoder.width))
    if mount.moves:
        candidates = similar_pairs(features, encoder.vlad(features), PARTNERS)
    else:
        candidates = _turned_least(frames)
    pairs: list[ImagePair] = []
    with ThreadPoolExecutor(cores()) as pool:
        points = list(pool.map(sift_features, images))

        def matched(pair: tuple[int, int]) -> ImagePair | None:
            i, j = pair
            rays = epipolar_rays(
                points[i], points[j], cameras[i], cameras[j], least_motion_px
            )
            if rays is None:
                return None
            return ImagePair(i, j, rays)

        for done, pair in enumerate(pool.map(matched, candidates), start=1):
            if pair:
                pairs.append(pair)
            on_progress("matching", done, len(candidates))
    return pairs


def _turned_least(frames: Sequence[Frame]) -> list[tuple[int, int]]:
    """Pairs of frames, each with those between which the gripper turned least."""
    rotation = Rotation.from_quat(
        stated_grippers(frames).rotation_wxyz, scalar_first=True
    )
    pairs = set()
    for i, first in enumerate(rotation):
        angles = (first.inv() * rotation).magnitude()
        nearest = np.argsort(angles, kind="stable")[1 : PARTNERS + 1]
        for j in nearest.tolist():
            pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)
