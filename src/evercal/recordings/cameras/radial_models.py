"""Lens models whose image radius depends on the angle to the axis, as the nearest fisheye.

Sources: Devernay and Faugeras, Straight lines have to be straight (MVA 2001) for `fov`; Mei and
Rives, Single view point omnidirectional camera calibration (ICRA 2007) for `omni`; Khomutenko et
al., An enhanced unified camera model (RA-L 2016) for `eucm`; Usenko et al., The double sphere
camera model (3DV 2018) for `ds`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from evercal.geometry import Camera
from evercal.geometry.camera import FISHEYE_DEG
from evercal.typing import Array

MOST_PX = 0.5
"""Largest error of the nearest fisheye."""


class RadialModel(NamedTuple):
    """A model without other distortion."""

    parameters: tuple[str, ...]
    radius: Callable[..., Array]
    """Image radius in focal lengths, of angles and parameters."""


def _fov(t: Array, w: float) -> Array:
    return np.arctan(2 * np.tan(t) * np.tan(w / 2)) / w if w else np.tan(t)


def _omni(t: Array, xi: float) -> Array:
    return np.sin(t) / (np.cos(t) + xi)


def _eucm(t: Array, alpha: float, beta: float) -> Array:
    away = np.sqrt(beta * np.sin(t) ** 2 + np.cos(t) ** 2)
    return np.sin(t) / (alpha * away + (1 - alpha) * np.cos(t))


def _ds(t: Array, xi: float, alpha: float) -> Array:
    second = np.sqrt(np.sin(t) ** 2 + (xi + np.cos(t)) ** 2)
    return np.sin(t) / (alpha * second + (1 - alpha) * (xi + np.cos(t)))


RADIAL_MODELS = {
    "fov": RadialModel(("omega",), _fov),
    "omni": RadialModel(("xi",), _omni),
    "eucm": RadialModel(("alpha", "beta"), _eucm),
    "ds": RadialModel(("xi", "alpha"), _ds),
}


def nearest_fisheye(
    name: str,
    parameters: Sequence[float],
    size: tuple[int, int],
    focal: tuple[float, float],
    centre: tuple[float, float],
) -> tuple[Camera, float]:
    """The fisheye that is nearest to a model of `RADIAL_MODELS`, and its largest error in pixels.

    Focal lengths and principal point are in pixels; the angles are those of the image.

    Raises:
        ValueError: No fisheye is near.
    """
    radius = RADIAL_MODELS[name].radius
    corner = np.hypot(*(np.maximum(centre, np.array(size) - 1 - centre) / focal))
    angles = np.deg2rad(np.linspace(0.05, FISHEYE_DEG, 400))
    radii = radius(angles, *parameters)
    rising = np.cumprod(np.diff(radii, append=np.inf) > 0).astype(bool)
    use = rising & np.isfinite(radii) & (radii <= corner * 1.01)
    powers = angles[use, None] ** np.arange(1, 10, 2)
    terms = np.linalg.lstsq(powers, radii[use], rcond=None)[0]
    off = float(np.abs(powers @ terms - radii[use]).max() * max(focal))
    if not off < MOST_PX:
        raise ValueError(f"no fisheye is nearer than {off:.1f} px to this {name} model")
    fx, fy = (terms[0] * f for f in focal)
    return Camera(*size, fx, fy, *centre, tuple(terms[1:] / terms[0]), "fisheye"), off
