"""Depth images of a camera: how they are read, and whether they measure right."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from evercal.bounds import require_image_size
from evercal.calibration.unseen.targets import Target
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.images import size_in_header
from evercal.storage.text_files import named_errors
from evercal.typing import Array, Pair

ENDINGS = (".png", ".npy", ".tif", ".tiff")
"""Endings of depth images."""
_LEAST = 12
"""Least number of depths that are compared."""
_NEAR = 0.1
"""Share by which a depth may differ from the true one; others are of other things."""
_NEAREST_M = 0.02
"""Median depth below which the unit is wrong."""
_FARTHEST_M = 30.0
"""The same above which it is."""


class DepthFit(NamedTuple):
    """Measured depths against those of landmarks or corners: measured = bias + scale depth."""

    bias_mm: float
    scale: float
    scale_sigma: float
    depths: int
    """Number of them."""


def read_depth(folder: Path, image: str, camera: Camera) -> Array:
    """The depth image (h, w) with the name of an image, metres; NaN without a measurement.

    Whole numbers are millimetres, others are metres.
    """
    import cv2

    files = [folder / f"{Path(image).stem}{ending}" for ending in ENDINGS]
    file = next(filter(Path.is_file, files), files[0])
    with named_errors(file, "depth image", "name it like its image"):
        if file.suffix == ".npy":
            depth = np.load(file, mmap_mode="r", allow_pickle=False)
        else:
            data = np.fromfile(file, np.uint8)
            require_image_size(*size_in_header(data), str(file))
            depth = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
        if depth.shape != (camera.height, camera.width):
            raise ValueError(
                f"has shape {depth.shape}, its image ({camera.height}, {camera.width})"
            )
        metres = np.where(depth > 0, depth, np.nan)
        if depth.dtype.kind in "iu":
            metres *= 0.001
        middle = np.nanmedian(metres)
        if not _NEAREST_M < middle < _FARTHEST_M:
            raise ValueError(
                f"median {middle:.3g} m; whole numbers are millimetres, others metres"
            )
    return metres


def depth_at(depth: Array, pixel: Array) -> float:
    """Median depth within two pixels; NaN where one is missing."""
    x, y = np.nan_to_num(np.round(pixel), nan=-9).astype(int)
    around = depth[max(y - 2, 0) : max(y + 3, 0), max(x - 2, 0) : max(x + 3, 0)]
    return float(np.median(around)) if around.size else np.nan


def depth_fit(folder: Path, camera: Camera, target: Target) -> DepthFit:
    """Compare depth images with the corners or landmarks of a target."""
    rows: list[Pair] = []
    for name, (pose, points) in target.items():
        depth = read_depth(folder, name, camera)
        places = pose.pose.apply(points)
        for place, pixel in zip(places, camera.project(places), strict=True):
            found = depth_at(depth, pixel)
            if abs(found / place[2] - 1) < _NEAR:
                rows.append((place[2], found))
    if len(rows) < _LEAST:
        raise InputError(
            f"{folder}: {len(rows)} depths are near those of landmarks or corners; {_LEAST} are"
            " needed"
        )
    true, measured = np.transpose(rows)
    line, covariance = np.polyfit(true, measured, 1, cov=True)
    sigma = float(np.sqrt(covariance[0, 0]))
    return DepthFit(1000 * float(line[1]), float(line[0]), sigma, len(rows))
