"""Images of a fisheye, from a renderer of ideal pinholes: five faces of a cube are warped."""

from collections.abc import Callable

import cv2
import numpy as np

from evercal.geometry import SE3, Camera
from evercal.typing import Image

_FACES = (
    (0.0, 0.0),
    (0.0, 90.0),
    (0.0, -90.0),
    (90.0, 0.0),
    (-90.0, 0.0),
)
"""Rotations of the cube's faces about x and y, degrees."""


def fisheye_image(
    camera: Camera,
    base_from_camera: SE3,
    render: Callable[[Camera, SE3], Image],
    finer: int = 2,
) -> Image:
    """An image (H, W, 3) of a fisheye; pixels without a ray are black.

    `render` gives the image of an ideal pinhole at a pose. Each pixel is the mean of finer x finer.
    """
    large = camera.resized(
        width=finer * camera.width,
        height=finer * camera.height,
    )
    v, u = np.mgrid[: large.height, : large.width]
    rays = large.unproject(np.stack([u, v], -1))
    lengths = np.linalg.norm(rays, axis=-1)
    face = _face_camera(int(2.2 * large.fx))
    image = np.zeros((large.height, large.width, 3), np.uint8)
    nearest = np.zeros(u.shape)
    for about_x, about_y in np.deg2rad(_FACES):
        turn = SE3.exp([0, 0, 0, about_x, about_y, 0])
        local = rays @ turn.rotation_matrix()
        # A ray belongs to the face whose axis is nearest.
        nearness = local[..., 2] / lengths
        in_face = nearness > nearest
        if not in_face.any():
            continue
        local[~in_face] = (0.0, 0.0, 1.0)
        pixels = face.project(local).astype(np.float32)
        rendered = render(face, base_from_camera @ turn)
        warped = cv2.remap(
            rendered,
            map1=pixels[..., 0],
            map2=pixels[..., 1],
            interpolation=cv2.INTER_LINEAR,
        )
        image[in_face] = warped[in_face]
        nearest[in_face] = nearness[in_face]
    size = (camera.width, camera.height)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _face_camera(side: int) -> Camera:
    """A pinhole for a face of the cube, with a border beside 90 degrees for the interpolation."""
    focal = side / 2.04
    centre = (side - 1) / 2
    return Camera(
        width=side,
        height=side,
        fx=focal,
        fy=focal,
        cx=centre,
        cy=centre,
    )
