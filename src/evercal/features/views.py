"""Views: images at the encoder's working size, plain or augmented.

An augmented view is the image of a camera with another rotation and focal length, but the same
centre. That image does not depend on the depths, so its pose is exact.
"""

from functools import lru_cache

import numpy as np

from evercal.classes import frozen
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.recordings.frame import Frame
from evercal.typing import Array, BoolArray, Image


@frozen
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


@frozen
class View:
    """One image for the encoder and the rays of its cells."""

    grey: Image
    cell_pixels: Array
    """(cells, 2) float32 pixels of the frame at the cell centres, in an ideal pinhole camera with
    `intrinsics`; row-major over the (h // stride, w // stride) grid."""
    valid: BoolArray
    """(cells,) bool: the cell shows a part of the image."""
    intrinsics: Array
    """(4,) fx, fy, cx, cy of the ideal pinhole, pixels."""
    base_from_camera: SE3
    """Pose of the frame; identity without a pose."""


def cell_centres(height: int, width: int, stride: int) -> Array:
    """(cells, 2) pixels (u, v) of the cell centres, row-major."""
    rows = height // stride
    columns = width // stride
    v, u = np.mgrid[0:rows, 0:columns]
    cells = np.stack([u, v], -1).reshape(-1, 2)
    return cells * float(stride) + (stride - 1) / 2


@lru_cache(maxsize=64)
def ideal_cell_pixels(camera: Camera, stride: int) -> Array:
    """(cells, 2) float32 pixels of the cell centres after removing the distortion.

    NaN where the distortion has no ray for a cell. The array is shared and cannot be written.
    """
    pixels = cell_centres(camera.height, camera.width, stride)
    if camera.distortion:
        plane = camera.unproject(pixels)[:, :2]
        pixels = _on_image(plane, camera)
    pixels = pixels.astype(np.float32)
    pixels.flags.writeable = False
    return pixels


def frame_view(frame: Frame, stride: int, options: ViewOptions) -> View:
    """The plain view of a frame; its cell pixels are free of distortion."""
    grey, camera = working_image(frame.read_image(), frame.camera, options.short_side)
    pixels = ideal_cell_pixels(camera, stride)
    valid = np.asarray(np.isfinite(pixels).all(axis=1))
    pose = frame.base_from_camera or SE3.identity()
    return View(
        grey=grey,
        cell_pixels=pixels,
        valid=valid,
        intrinsics=_four(camera),
        base_from_camera=pose,
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
    rotvec = rng.uniform(-1, 1, 3) * [tilt, tilt, roll]
    tangent = np.array([0, 0, 0, *rotvec])
    rotation = SE3.exp(tangent)
    camera_from_view = rotation.rotation_matrix()
    height, width = grey.shape
    virtual = camera.zoomed(zoom).pinhole
    if camera.distortion:
        v, u = np.mgrid[0:height, 0:width]
        places = np.stack([u, v], -1).astype(float)
        rays = virtual.unproject(places) @ camera_from_view.T
        source = camera.project(rays)
        source = np.nan_to_num(source, nan=-1.0)
        source = source.astype(np.float32)
        warped = cv2.remap(
            grey,
            source,
            None,  # type: ignore[call-overload]
            interpolation=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
    else:
        view_from_pixels = np.linalg.inv(virtual.matrix())
        homography = camera.matrix() @ camera_from_view @ view_from_pixels
        warped = cv2.warpPerspective(
            grey,
            homography,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT,
        )
    exponent = np.exp(rng.normal(0, options.gamma))
    warped = cv2.LUT(warped, _gamma_table(exponent))
    centres = cell_centres(height, width, stride)
    ray = virtual.unproject(centres) @ camera_from_view.T
    source = camera.project(ray)
    inside = (source >= 0) & (source <= [width - 1, height - 1])
    plane = ray[:, :2] / ray[:, 2:]
    pixels = _on_image(plane, camera)
    assert frame.base_from_camera, "augmented frames have poses"
    return View(
        grey=np.asarray(warped, np.uint8),
        cell_pixels=pixels.astype(np.float32),
        valid=np.all(inside, axis=-1),
        intrinsics=_four(camera),
        base_from_camera=frame.base_from_camera,
    )


def working_image(
    image: Image, camera: Camera, short_side: int
) -> tuple[Image, Camera]:
    """Grey (h, w) uint8 image with the given shorter side, and its camera.

    The image, (h, w, 3) uint8 RGB or (h, w) grey, may have any size with the camera's aspect ratio.
    """
    import cv2

    grey = image
    if image.ndim == 3:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = camera.short_side_resized(short_side)
    size = small.size
    if grey.shape != (small.height, small.width):
        if small.height < grey.shape[0]:
            grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        else:
            # OpenCV 5.0.0 on arm64 errs by 3 grey levels with one channel, with two it does not.
            twice = cv2.merge([grey, grey])
            large = cv2.resize(twice, size, interpolation=cv2.INTER_LINEAR)
            grey = cv2.extractChannel(large, 0)
    return np.asarray(grey, np.uint8), small


def working_grey(image: Image, short_side: int) -> Image:
    """Grey (h, w) uint8 image with the given shorter side, see `working_image`."""
    height, width = image.shape[:2]
    camera = Camera(
        width,
        height,
        fx=1,
        fy=1,
        cx=0,
        cy=0,
    )
    grey, _ = working_image(image, camera, short_side)
    return grey


def _gamma_table(exponent: float) -> Image:
    """(256,) intensities after a change of brightness."""
    linear = np.arange(256) / 255.0
    table = linear**exponent * 255
    return table.astype(np.uint8)


def _on_image(plane: Array, camera: Camera) -> Array:
    """Pixels (n, 2) of points of the plane z = 1, without distortion."""
    focal = [camera.fx, camera.fy]
    centre = [camera.cx, camera.cy]
    return plane * focal + centre


def _four(camera: Camera) -> Array:
    """(4,) fx, fy, cx, cy."""
    four = [camera.fx, camera.fy, camera.cx, camera.cy]
    return np.array(four, np.float32)
