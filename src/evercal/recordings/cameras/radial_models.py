"""Lens models whose image radius depends on the angle to the axis, as the nearest fisheye.

Sources: Devernay and Faugeras, Straight lines have to be straight (MVA 2001) for `fov`; Mei and
Rives, Single view point omnidirectional camera calibration (ICRA 2007) for `omni`; Khomutenko et
al., An enhanced unified camera model (RA-L 2016) for `eucm`; Usenko et al., The double sphere
camera model (3DV 2018) for `ds`.
"""

from collections.abc import Sequence

import numpy as np

from evercal.geometry import Camera
from evercal.geometry.distortion import FISHEYE_DEG
from evercal.typing import Array

MAX_ERROR_PX = 0.5
"""Largest difference between a model and the fisheye that replaces it, pixels."""


RADIAL_MODELS = {
    "fov": ("omega",),
    "omni": ("xi",),
    "ucm": ("alpha",),
    "eucm": ("alpha", "beta"),
    "ds": ("xi", "alpha"),
    "division": ("divundistdistortion",),
}
"""Parameters of the models by their names at Kalibr, COLMAP, Basalt and OpenICC."""


def image_radius(name: str, angle: Array, parameters: Sequence[float]) -> Array:
    """Image radius in focal lengths, of (n,) angles to the axis."""
    if name == "fov":
        (omega,) = parameters
        tangent = 2 * np.tan(angle) * np.tan(omega / 2)
        return np.arctan(tangent) / omega
    if name == "division":
        ideal = np.tan(angle)
        return 2 * ideal / (1 + np.sqrt(1 - 4 * parameters[0] * ideal**2))
    named = dict(zip(RADIAL_MODELS[name], parameters, strict=True))
    return _by_spheres(angle, **named)


def _by_spheres(
    angle: Array, xi: float = 0.0, alpha: float = 0.0, beta: float = 1.0
) -> Array:
    """Two spheres with centres xi apart; `omni` has one, and that of `eucm` is an ellipsoid."""
    sine = np.sin(angle)
    shifted = xi + np.cos(angle)
    squared = beta * sine**2 + shifted**2
    depth = alpha * np.sqrt(squared) + (1 - alpha) * shifted
    return sine / depth


def nearest_fisheye(
    name: str,
    parameters: Sequence[float],
    size: Sequence[int],
    focal: Sequence[float],
    centre: Sequence[float],
) -> Camera:
    """The fisheye that is nearest to a model of `RADIAL_MODELS`, by least squares.

    Focal lengths and principal point are in pixels; the angles are those of the image.

    Raises:
        ValueError: No fisheye is within `MAX_ERROR_PX`.
    """
    last_pixel = np.array(size) - 1
    corner = np.maximum(centre, last_pixel - centre)
    largest = np.hypot(*(corner / focal)) * 1.01
    angles = np.deg2rad(np.linspace(0.05, FISHEYE_DEG, 400))
    radii = image_radius(name, angles, parameters)
    steps = np.diff(radii, append=np.inf)
    rising = np.logical_and.accumulate(steps > 0)
    in_image = rising & np.isfinite(radii) & (radii <= largest)
    angles = angles[in_image]
    radii = radii[in_image]
    powers = angles[:, None] ** np.arange(1, 10, 2)
    terms = np.linalg.lstsq(powers, radii, rcond=None)[0]
    residuals = powers @ terms - radii
    error = np.abs(residuals).max() * max(focal)
    if not error < MAX_ERROR_PX:
        raise ValueError(
            f"no fisheye is nearer than {error:.1f} px to this {name} model"
        )
    scale = terms[0]
    width, height = size
    fx, fy = scale * np.array(focal)
    cx, cy = centre
    distortion = tuple(terms[1:] / scale)
    return Camera(width, height, fx, fy, cx, cy, distortion, "fisheye")
