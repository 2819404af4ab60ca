"""Images of a fisheye, from a renderer of ideal pinholes: five faces of a cube are warped."""

from collections.abc import Callable

import cv2
import numpy as np

from evercal.geometry import SE3, Camera
from evercal.typing import Image

_FACES = [(0.0, 0.0), (0.0, 90.0), (0.0, -90.0), (90.0, 0.0), (-90.0, 0.0)]
"""Turns of the faces about x and y, degrees."""


def fisheye_image(
    camera: Camera,
    base_from_camera: SE3,
    render: Callable[[Camera, SE3], Image],
    finer: int = 2,
) -> Image:
    """An image (H, W, 3) of a fisheye; pixels without a ray are black.

    `render` gives the image of an ideal pinhole at a pose. Each pixel is the mean of finer x finer.
    """
    large = camera.resized(finer * camera.width, finer * camera.height)
    v, u = np.mgrid[0 : large.height, 0 : large.width]
    rays = large.unproject(np.stack([u, v], -1))
    side = int(2.2 * large.fx)
    # A border of some pixels beside 90 degrees for the interpolation.
    face = Camera(side, side, side / 2.04, side / 2.04, (side - 1) / 2, (side - 1) / 2)
    image = np.zeros((large.height, large.width, 3), np.uint8)
    best = np.zeros(u.shape)
    for about_x, about_y in _FACES:
        turn = SE3.exp([0, 0, 0, np.deg2rad(about_x), np.deg2rad(about_y), 0])
        local = rays @ turn.rotation_matrix()
        # A ray belongs to the face whose axis is nearest.
        nearness = local[..., 2] / np.linalg.norm(rays, axis=-1)
        mine = nearness > best
        if not mine.any():
            continue
        source = face.project(np.where(mine[..., None], local, (0.0, 0.0, 1.0))).astype(
            np.float32
        )
        seen = render(face, base_from_camera @ turn)
        warped = cv2.remap(seen, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
        image[mine] = warped[mine]
        best[mine] = nearness[mine]
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
