"""The camera: a pinhole with OpenCV's distortion, or a fisheye.

A fisheye (Kannala and Brandt, PAMI 2006; `cv2.fisheye`) maps the angle t to the optical axis to the
radius f t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8). Both are distortions of the plane z = 1, which
ends before 90 degrees: rays of a fisheye beyond `FISHEYE_DEG` are left out.

Conventions: OpenCV axes (x right, y down, z forward). Pixel (0, 0) is the CENTRE of the top-left
pixel, as in OpenCV and ROS, so an image covers -0.5 .. width - 0.5 and its middle is at
(width - 1) / 2.
"""

import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from evercal.choices import CameraModel
from evercal.geometry.distortion import (
    angle_per_radius,
    radial_fisheye,
    radial_pinhole,
    widest_fisheye,
    widest_pinhole,
)
from evercal.typing import Array, ArrayPair, Floats, JsonObject, Record, Size, Strings

COEFFICIENTS: dict[str, Strings] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Names of the distortion coefficients of each model, in OpenCV's order."""
COEFFICIENT_COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
"""Allowed numbers of coefficients of each model."""
_EXACT = 1e-10
"""Tolerance of undistorted points on the plane z = 1."""
_ASPECT_TOLERANCE = 0.01
"""Maximum relative difference of aspect ratios."""


def resize_pixels(pixels: ArrayLike, scale: float | Array) -> Array:
    """Pixel coordinates in a resized image; the scale is new size over old, or one for each axis.

    Resizing scales about the corner of the image, which lies at -0.5 and not at 0.
    """
    return np.asarray((np.asarray(pixels) + 0.5) * scale - 0.5)


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera at one image size."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fx: float
    """Focal length along x in pixels."""
    fy: float
    """Focal length along y in pixels."""
    cx: float
    """Principal point in pixels; 0 is the centre of the leftmost pixel."""
    cy: float
    """Principal point in pixels; 0 is the centre of the topmost pixel."""
    distortion: Floats = ()
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty without distortion. Zeros become empty.
    Of a fisheye k1 k2 k3 k4, also zeros."""
    model: CameraModel = "pinhole"

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not (1 <= value < math.inf) or int(value) != value:
                raise ValueError(
                    f"camera {name} is a whole number of pixels >= 1, got {value}"
                )
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "cx", "cy"):
            value = float(getattr(self, name))
            positive = value > 0 or name in ("cx", "cy")
            if not math.isfinite(value) or not positive:
                raise ValueError(
                    f"camera {name} is finite (and > 0 for fx, fy), got {value}"
                )
            object.__setattr__(self, name, value)
        if self.model not in COEFFICIENT_COUNTS:
            raise ValueError(f"camera model is pinhole or fisheye, got {self.model!r}")
        distortion = tuple(float(value) for value in self.distortion)
        counts = COEFFICIENT_COUNTS[self.model]
        if len(distortion) not in counts or not all(map(math.isfinite, distortion)):
            names = " ".join(COEFFICIENTS[self.model])
            raise ValueError(
                f"camera distortion has {', '.join(map(str, counts[:-1]))} or {counts[-1]} finite"
                f" coefficients (OpenCV's {names}), got {distortion}"
            )
        if not any(distortion):
            distortion = ()
            if self.model == "fisheye":
                distortion = (0.0,) * 4
        object.__setattr__(self, "distortion", distortion)

    @classmethod
    def from_matrix(
        cls,
        matrix: ArrayLike,
        width: int,
        height: int,
        distortion: Floats = (),
    ) -> Self:
        """Convert a 3x3 intrinsic matrix without skew."""
        k = np.asarray(matrix, float)
        if k.shape != (3, 3):
            raise ValueError(f"an intrinsic matrix is 3x3, got {k.shape}")
        zeros = np.abs([k[0, 1], k[1, 0]])
        if zeros.max() > 1e-9 or not np.allclose(k[2], (0, 0, 1)):
            raise ValueError(
                f"an intrinsic matrix is [fx 0 cx; 0 fy cy; 0 0 1], got {k.tolist()}; skew is"
                f" not supported"
            )
        return cls(
            width,
            height,
            fx=k[0, 0],
            fy=k[1, 1],
            cx=k[0, 2],
            cy=k[1, 2],
            distortion=distortion,
        )

    @cached_property
    def size(self) -> Size:
        """Width and height of its images, pixels."""
        return self.width, self.height

    @property
    def coefficients(self) -> Floats:
        """All eight distortion coefficients; missing ones are 0."""
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))

    @cached_property
    def widest(self) -> float:
        """Largest tangent of the angle to the optical axis at which the distortion is valid.

        Beyond it the polynomial folds back, so points far outside the view land in the image.
        """
        if self.model == "fisheye":
            return widest_fisheye(self.distortion)
        return widest_pinhole(self.coefficients)

    @property
    def pinhole(self) -> "Camera":
        """The same camera without distortion."""
        if not self.distortion:
            return self
        return replace(self, distortion=(), model="pinhole")

    def changed(self, change: ArrayLike) -> "Camera":
        """The camera after a change (3 + k,) of the parameters of `slopes`."""
        log_focal, x, y, *more = np.asarray(change, float).tolist()
        terms = np.array(self.coefficients)
        terms[: len(more)] += more
        count = max(4, len(more), len(self.distortion))
        count = min(count, len(COEFFICIENTS[self.model]))
        factor = math.exp(log_focal)
        return replace(
            self,
            fx=factor * self.fx,
            fy=factor * self.fy,
            cx=self.cx + x,
            cy=self.cy + y,
            distortion=tuple(terms[:count].tolist()),
        )

    def fits(self, width: int, height: int) -> bool:
        """Whether an image has the aspect ratio of this camera, to 1 %."""
        ratio = self.width * height / (self.height * width)
        return abs(ratio - 1) < _ASPECT_TOLERANCE

    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix."""
        return np.array(
            [
                [self.fx, 0.0, self.cx],
                [0.0, self.fy, self.cy],
                [0.0, 0.0, 1.0],
            ]
        )

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of the same image resized to `width` x `height` pixels."""
        sx = width / self.width
        sy = height / self.height
        cx, cy = resize_pixels((self.cx, self.cy), np.array([sx, sy])).tolist()
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=cx,
            cy=cy,
        )

    def short_side_resized(self, short_side: int) -> "Camera":
        """The camera of the image resized so that its shorter side is `short_side` pixels."""
        scale = short_side / min(self.width, self.height)
        width = short_side
        height = short_side
        if self.width <= self.height:
            height = max(1, round(self.height * scale))
        else:
            width = max(1, round(self.width * scale))
        return self.resized(width, height)

    def zoomed(self, factor: float) -> "Camera":
        """The camera with its focal lengths multiplied by a factor."""
        return replace(self, fx=factor * self.fx, fy=factor * self.fy)

    def project(self, points_camera: ArrayLike) -> Array:
        """Points (..., 3) in the camera frame to pixels (..., 2), not clipped to the image.

        NaN for points behind the camera or beyond the range of the distortion (`widest`).
        """
        points = np.asarray(points_camera, float)
        if points.shape[-1:] != (3,):
            raise ValueError(f"points are (..., 3), got {points.shape}")
        # One array for each coordinate: sums along pairs take several times as long.
        x = points[..., 0]
        y = points[..., 1]
        depth = points[..., 2]
        if not (depth > 0).all():
            depth = np.where(depth > 0, depth, np.nan)
        x = x / depth
        y = y / depth
        if self.distortion:
            within = x * x + y * y < self.widest**2
            x = np.where(within, x, np.nan)
            y = np.where(within, y, np.nan)
            (x, y), _ = self._distorted(x, y)
        u = self.fx * x + self.cx
        v = self.fy * y + self.cy
        return np.stack([u, v], axis=-1)

    def unproject(self, pixels: ArrayLike) -> Array:
        """Pixels (..., 2) to rays (..., 3) with z = 1; NaN outside the range of the distortion."""
        pixels = np.asarray(pixels, float)
        if pixels.shape[-1:] != (2,):
            raise ValueError(f"pixels are (..., 2), got {pixels.shape}")
        plane = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion and pixels.size:
            plane = self._undistorted(plane)
        depth = np.ones((*plane.shape[:-1], 1))
        return np.concatenate([plane, depth], axis=-1)

    def slopes(self, plane: ArrayLike, terms: int = 2) -> ArrayPair:
        """Derivatives of pixels by ideal points (..., 2) of the plane z = 1, and by intrinsics.

        The first are (..., 2, 2). The others are (..., 2, 3 + terms): by the logarithm of both
        focal lengths, the principal point in pixels, and the first distortion coefficients in
        OpenCV's order, at most five.
        """
        plane = np.asarray(plane, float)
        x = plane[..., 0]
        y = plane[..., 1]
        (u, v), (a, b, d) = self._distorted(x, y)
        # One row for each entry: products of small matrices take several times as long.
        by_plane = np.empty((2, 2, *x.shape))
        lens = np.zeros((2, 3 + max(terms, 2), *x.shape))
        by_plane[0, 0] = self.fx * a
        by_plane[0, 1] = self.fx * b
        by_plane[1, 0] = self.fy * b
        by_plane[1, 1] = self.fy * d
        r2 = x * x + y * y
        first = r2
        next_power = r2
        if self.model == "fisheye":
            next_power = np.arctan(np.sqrt(r2)) ** 2
            first = next_power * angle_per_radius(r2)
        elif any(self.coefficients[5:]):
            k4, k5, k6 = self.coefficients[5:]
            first = r2 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        lens[0, 0] = self.fx * u
        lens[1, 0] = self.fy * v
        lens[0, 1] = 1
        lens[1, 2] = 1
        lens[0, 3] = self.fx * x * first
        lens[1, 3] = self.fy * y * first
        lens[:, 4] = lens[:, 3] * next_power
        if terms > 2 and self.model == "fisheye":
            lens[:, 5] = lens[:, 4] * next_power
            lens[:, 6] = lens[:, 5] * next_power
        elif terms > 2:
            cross = 2 * x * y
            lens[0, 5:7] = self.fx * np.stack([cross, r2 + 2 * x * x])
            lens[1, 5:7] = self.fy * np.stack([r2 + 2 * y * y, cross])
            lens[:, 7] = lens[:, 4] * next_power
        by_plane = np.moveaxis(by_plane, (0, 1), (-2, -1))
        return by_plane, np.moveaxis(lens, (0, 1), (-2, -1))

    def to_dict(self) -> JsonObject:
        """Plain numbers for JSON; the model only of a fisheye."""
        values: JsonObject = asdict(self)
        values["distortion"] = list(self.distortion)
        if self.model != "fisheye":
            del values["model"]
        return values

    @classmethod
    def from_dict(cls, data: Record) -> Self:
        """Inverse of `to_dict`; unknown keys are ignored, `distortion` is optional."""
        numbers: JsonObject = {}
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            numbers[name] = _number(data.get(name), name)
        distortion = data.get("distortion", ())
        if not isinstance(distortion, (list, tuple)):
            raise ValueError(
                f"camera 'distortion' is a list of numbers, got {distortion!r}"
            )
        model: Any = data.get("model", "pinhole")
        return cls(
            **numbers,
            distortion=tuple(_number(k, "distortion") for k in distortion),
            model=model,
        )

    def _distorted(self, x: Array, y: Array) -> tuple[ArrayPair, tuple[Array, ...]]:
        """Distorted points (u, v), and their derivatives du/dx, du/dy = dv/dx and dv/dy."""
        xx = x * x
        yy = y * y
        r2 = xx + yy
        if self.model == "fisheye":
            p1 = 0.0
            p2 = 0.0
            radial, change = radial_fisheye(self.distortion, r2)
        else:
            p1, p2 = self.coefficients[2:4]
            radial, change = radial_pinhole(self.coefficients, r2)
        twice = 2 * change
        u = x * radial
        v = y * radial
        cross = x * y * twice
        a = radial + xx * twice
        d = radial + yy * twice
        if p1 or p2:
            u = u + 2 * p1 * x * y + p2 * (r2 + 2 * xx)
            v = v + p1 * (r2 + 2 * yy) + 2 * p2 * x * y
            cross = cross + 2 * (p1 * x + p2 * y)
            a = a + 2 * p1 * y + 6 * p2 * x
            d = d + 6 * p1 * y + 2 * p2 * x
        return (u, v), (a, cross, d)

    def _angles(self, radii: Array) -> Array:
        """Angles of a fisheye at distorted radii (...); NaN outside its range."""
        k1, k2, k3, k4 = self.distortion
        radius = Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])
        slope = radius.deriv()
        most = math.atan(self.widest)
        angles = np.minimum(radii, most)
        error = radius(angles) - radii
        for _ in range(50):  # Newton's method: a few steps but close to a fold
            if (np.abs(error) < _EXACT).all():
                break
            step = error / np.maximum(slope(angles), 1e-6)
            angles = np.clip(angles - step, 0, most)
            error = radius(angles) - radii
        return np.where(np.abs(error) < _EXACT, angles, np.nan)

    def _undistorted(self, distorted: Array) -> Array:
        """(..., 2) ideal points of the plane z = 1; NaN outside the range of the distortion."""
        if self.model == "fisheye":
            radii = np.linalg.norm(distorted, axis=-1, keepdims=True)
            return distorted * np.tan(self._angles(radii)) / np.maximum(radii, 1e-12)
        plane = distorted
        lost = np.ones(distorted.shape[:-1], bool)
        for _ in range(50):  # Newton's method: a few steps but close to `widest`
            radius = np.sqrt((plane**2).sum(-1, keepdims=True))
            inside = 0.999999 * self.widest / np.maximum(radius, 1e-12)
            plane = plane * np.minimum(1, inside)
            (u, v), (a, b, d) = self._distorted(plane[..., 0], plane[..., 1])
            u = u - distorted[..., 0]
            v = v - distorted[..., 1]
            lost = np.maximum(np.abs(u), np.abs(v)) > _EXACT
            if not lost.any():
                break
            step = np.stack([d * u - b * v, a * v - b * u], -1)
            determinant = a * d - b * b
            plane = plane - step / determinant[..., None]
        return np.where(lost[..., None], np.nan, plane)


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"camera '{name}' is a number, got {value!r}")
    return float(value)
