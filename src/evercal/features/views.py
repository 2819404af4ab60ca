"""Views: images at the encoder's working size, plain or augmented.

An augmented view is the image of a camera with another rotation and focal length, but the same
centre. That image does not depend on the depths, so its pose is exact.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.recordings.frame import Frame


@dataclass(frozen=True)
class ViewOptions:
    """Working size and augmentation."""

    short_side: int = 240
    """Pixels of the shorter image side that the encoder works on."""
    zoom: float = 1.4
    """Augmented views scale the focal length by a factor drawn from [1 / zoom, zoom]."""
    roll_deg: float = 20.0
    """Largest rotation of augmented views about the optical axis."""
    tilt_deg: float = 6.0
    """Largest rotation of augmented views about each other axis."""
    gamma: float = 0.3
    """Standard deviation of the logarithm of the brightness exponent."""


@dataclass(frozen=True)
class View:
    """One image for the encoder and the rays of its cells."""

    grey: np.ndarray
    cell_pixels: np.ndarray
    """(cells, 2) float32 pixels of the frame at the cell centres, in an ideal pinhole camera with
    `intrinsics`; row-major over the (h // stride, w // stride) grid."""
    valid: np.ndarray
    """(cells,) bool: the cell shows a part of the image."""
    intrinsics: np.ndarray
    """(4,) fx, fy, cx, cy of the ideal pinhole, pixels."""
    base_from_camera: SE3
    """Pose of the frame; identity without a pose."""


def cell_centres(height: int, width: int, stride: int) -> np.ndarray:
    """(cells, 2) pixels (u, v) of the cell centres, row-major."""
    v, u = np.mgrid[0 : height // stride, 0 : width // stride]
    return np.stack([u, v], -1).reshape(-1, 2) * float(stride) + (stride - 1) / 2


@lru_cache(maxsize=64)
def ideal_cell_pixels(camera: Camera, stride: int) -> np.ndarray:
    """(cells, 2) float32 pixels of the cell centres after removing the distortion.

    NaN where the distortion has no ray for a cell. The array is shared and cannot be written.
    """
    pixels = cell_centres(camera.height, camera.width, stride)
    if camera.distortion:
        rays = camera.unproject(pixels)
        pixels = rays[:, :2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    pixels = pixels.astype(np.float32)
    pixels.flags.writeable = False
    return pixels


def frame_view(frame: Frame, stride: int, options: ViewOptions) -> View:
    """The plain view of a frame; its cell pixels are free of distortion."""
    grey, camera = working_image(frame.read_image(), frame.camera, options.short_side)
    pixels = ideal_cell_pixels(camera, stride)
    valid = np.asarray(np.isfinite(pixels).all(axis=1))
    return View(
        grey, pixels, valid, _four(camera), frame.base_from_camera or SE3.identity()
    )


def augmented_view(
    frame: Frame, stride: int, options: ViewOptions, rng: np.random.Generator
) -> View:
    """A random view of a posed frame from the same camera centre.

    Cells are given by the pixels of the original image, so pose and intrinsics are the frame's.
    """
    import cv2

    grey, camera = working_image(frame.read_image(), frame.camera, options.short_side)
    zoom = options.zoom ** rng.uniform(-1, 1)
    roll = np.deg2rad(options.roll_deg)
    tilt = np.deg2rad(options.tilt_deg)
    rotation = SE3.exp(
        np.array([0, 0, 0, *(rng.uniform(-1, 1, 3) * [tilt, tilt, roll])])
    )
    camera_from_view = rotation.rotation_matrix()
    height, width = grey.shape
    virtual = Camera(
        width, height, zoom * camera.fx, zoom * camera.fy, camera.cx, camera.cy
    )
    homography = camera.matrix() @ camera_from_view @ np.linalg.inv(virtual.matrix())
    ray = virtual.unproject(cell_centres(height, width, stride)) @ camera_from_view.T
    if camera.distortion:
        v, u = np.mgrid[0:height, 0:width]
        rays = (
            virtual.unproject(np.stack([u, v], -1).astype(float)) @ camera_from_view.T
        )
        source = np.nan_to_num(camera.project(rays), nan=-1.0).astype(np.float32)
        border = cv2.BORDER_REFLECT
        warped = cv2.remap(grey, source, None, cv2.INTER_LINEAR, borderMode=border)  # type: ignore[call-overload]
    else:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (width, height)
        border = cv2.BORDER_REFLECT
        warped = cv2.warpPerspective(
            grey, homography, size, flags=flags, borderMode=border
        )
    table = (np.arange(256) / 255.0) ** np.exp(rng.normal(0, options.gamma)) * 255
    warped = cv2.LUT(warped, table.astype(np.uint8))
    source = camera.project(ray)
    valid = np.all((source >= 0) & (source <= [width - 1, height - 1]), axis=-1)
    plane = ray[:, :2] / ray[:, 2:]
    pixels = plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert frame.base_from_camera is not None, "augmented frames have poses"
    return View(
        warped, pixels.astype(np.float32), valid, _four(camera), frame.base_from_camera
    )


def working_image(
    image: np.ndarray, camera: Camera, short_side: int
) -> tuple[np.ndarray, Camera]:
    """Grey (h, w) uint8 image with the given shorter side, and its camera.

    The image, (h, w, 3) uint8 RGB or (h, w) grey, may have any size with the camera's aspect ratio.
    """
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = camera.short_side_resized(short_side)
    if grey.shape != (small.height, small.width):
        shrink = small.height < grey.shape[0]
        kind = cv2.INTER_AREA if shrink else cv2.INTER_LINEAR
        grey = cv2.resize(grey, (small.width, small.height), interpolation=kind)
    return grey, small


def working_grey(image: np.ndarray, short_side: int) -> np.ndarray:
    """Grey (h, w) uint8 image with the given shorter side, see `working_image`."""
    height, width = image.shape[:2]
    return working_image(image, Camera(width, height, 1, 1, 0, 0), short_side)[0]


def _four(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
