"""The camera: a pinhole with OpenCV's distortion, or a fisheye.

A fisheye (Kannala and Brandt, PAMI 2006; `cv2.fisheye`) maps the angle t to the optical axis to the
radius f t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8). Both are distortions of the plane z = 1, which
ends before 90 degrees: rays of a fisheye beyond `FISHEYE_DEG` are left out.

Conventions: OpenCV axes (x right, y down, z forward). Pixel (0, 0) is the CENTRE of the top-left
pixel, as in OpenCV and ROS, so an image covers -0.5 .. width - 0.5 and its middle is at
(width - 1) / 2.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from evercal.choices import CameraModel
from evercal.typing import Array

FISHEYE_DEG = 85.0
"""Largest angle to the optical axis of a ray of a fisheye."""
COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Names of the distortion coefficients of each model, in OpenCV's order."""
_COEFFICIENT_COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
_EXACT = 1e-10
"""Tolerance of undistorted points on the plane z = 1."""
_ASPECT_TOLERANCE = 0.01


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
    distortion: tuple[float, ...] = ()
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
            if not math.isfinite(value) or (name.startswith("f") and value <= 0):
                raise ValueError(
                    f"camera {name} is finite (and > 0 for fx, fy), got {value}"
                )
            object.__setattr__(self, name, value)
        if self.model not in _COEFFICIENT_COUNTS:
            raise ValueError(f"camera model is pinhole or fisheye, got {self.model!r}")
        distortion = tuple(float(value) for value in self.distortion)
        counts = _COEFFICIENT_COUNTS[self.model]
        if len(distortion) not in counts or not all(map(math.isfinite, distortion)):
            names = " ".join(COEFFICIENTS[self.model])
            raise ValueError(
                f"camera distortion has {', '.join(map(str, counts[:-1]))} or {counts[-1]} finite"
                f" coefficients (OpenCV's {names}), got {distortion}"
            )
        none = (0.0,) * 4 if self.model == "fisheye" else ()
        object.__setattr__(self, "distortion", distortion if any(distortion) else none)

    @classmethod
    def from_matrix(
        cls,
        matrix: ArrayLike,
        width: int,
        height: int,
        distortion: tuple[float, ...] = (),
    ) -> Self:
        """Convert a 3x3 intrinsic matrix without skew."""
        k = np.asarray(matrix, dtype=np.float64)
        if k.shape != (3, 3):
            raise ValueError(f"an intrinsic matrix is 3x3, got {k.shape}")
        if (
            abs(k[0, 1]) > 1e-9
            or abs(k[1, 0]) > 1e-9
            or not np.allclose(k[2], (0, 0, 1))
        ):
            raise ValueError(
                f"an intrinsic matrix is [fx 0 cx; 0 fy cy; 0 0 1], got {k.tolist()}; skew is"
                f" not supported"
            )
        return cls(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], distortion)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """All eight distortion coefficients; missing ones are 0."""
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))

    @cached_property
    def widest(self) -> float:
        """Largest tangent of the angle to the optical axis at which the distortion is valid.

        Beyond it the polynomial folds back, so points far outside the view land in the image.
        """
        if self.model == "fisheye":
            folds = _roots(
                [
                    1.0,
                    *(
                        n * k
                        for n, k in zip((3, 5, 7, 9), self.distortion, strict=True)
                    ),
                ]
            )
            return math.tan(
                min(math.sqrt(min(folds, default=9.0)), math.radians(FISHEYE_DEG))
            )
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients
        if not (k4 or k5 or k6):
            return math.sqrt(
                min(_roots([1.0, 3 * k1, 5 * k2, 7 * k3]), default=math.inf)
            )
        squared = np.polynomial.Polynomial([0, 1])
        above = np.polynomial.Polynomial([1, k1, k2, k3])
        below = np.polynomial.Polynomial([1, k4, k5, k6])
        slope = above * below + 2 * squared * (
            above.deriv() * below - above * below.deriv()
        )
        return math.sqrt(
            min([*_roots(slope.coef), *_roots(below.coef)], default=math.inf)
        )

    @property
    def pinhole(self) -> "Camera":
        """The same camera without distortion."""
        return (
            replace(self, distortion=(), model="pinhole") if self.distortion else self
        )

    def changed(self, change: ArrayLike) -> "Camera":
        """The camera after a change (5,) of the parameters of `slopes`."""
        log_focal, x, y, *radial = np.asarray(change, np.float64).tolist()
        coefficients = self.coefficients[: max(4, len(self.distortion))]
        factor, (k1, k2, *others) = math.exp(log_focal), coefficients
        return replace(
            self,
            fx=factor * self.fx,
            fy=factor * self.fy,
            cx=self.cx + x,
            cy=self.cy + y,
            distortion=(k1 + radial[0], k2 + radial[1], *others),
        )

    def fits(self, width: int, height: int) -> bool:
        """Whether an image has the aspect ratio of this camera, to 1 %."""
        ratio = self.width * height / (self.height * width)
        return abs(ratio - 1) < _ASPECT_TOLERANCE

    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix."""
        return np.array(
            [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        )

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of the same image resized to `width` x `height` pixels."""
        sx = width / self.width
        sy = height / self.height
        cx, cy = resize_pixels((self.cx, self.cy), np.array([sx, sy])).tolist()
        fx = self.fx * sx
        fy = self.fy * sy
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)

    def short_side_resized(self, short_side: int) -> "Camera":
        """The camera of the image resized so that its shorter side is `short_side` pixels."""
        scale = short_side / min(self.width, self.height)
        if self.width <= self.height:
            return self.resized(short_side, max(1, round(self.height * scale)))
        return self.resized(max(1, round(self.width * scale)), short_side)

    def zoomed(self, factor: float) -> "Camera":
        """The camera with its focal lengths multiplied by a factor."""
        return replace(self, fx=factor * self.fx, fy=factor * self.fy)

    def project(self, points_camera: ArrayLike) -> Array:
        """Points (..., 3) in the camera frame to pixels (..., 2), not clipped to the image.

        NaN for points behind the camera or beyond the range of the distortion (`widest`).
        """
        points = np.asarray(points_camera, dtype=np.float64)
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
            (x, y), _ = self._distorted(
                np.where(within, x, np.nan), np.where(within, y, np.nan)
            )
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)

    def unproject(self, pixels: ArrayLike) -> Array:
        """Pixels (..., 2) to rays (..., 3) with z = 1; NaN outside the range of the distortion."""
        pixels = np.asarray(pixels, dtype=np.float64)
        if pixels.shape[-1:] != (2,):
            raise ValueError(f"pixels are (..., 2), got {pixels.shape}")
        plane = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion and pixels.size:
            plane = self._undistorted(plane)
        return np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)

    def slopes(self, plane: ArrayLike) -> tuple[Array, Array]:
        """Derivatives of pixels by ideal points (..., 2) of the plane z = 1, and by intrinsics.

        The first are (..., 2, 2). The others are (..., 2, 5): by the logarithm of both focal
        lengths, the principal point in pixels, k1 and k2.
        """
        plane = np.asarray(plane, dtype=np.float64)
        x = plane[..., 0]
        y = plane[..., 1]
        (u, v), (a, b, d) = self._distorted(x, y)
        # One row for each entry: products of small matrices take several times as long.
        by_plane = np.empty((2, 2, *x.shape))
        lens = np.zeros((2, 5, *x.shape))
        by_plane[0, 0] = self.fx * a
        by_plane[0, 1] = self.fx * b
        by_plane[1, 0] = self.fy * b
        by_plane[1, 1] = self.fy * d
        r2 = x * x + y * y
        first = r2
        next_power = r2
        if self.model == "fisheye":
            next_power = np.arctan(np.sqrt(r2)) ** 2
            first = next_power * _angle_per_radius(r2)
        elif any(self.coefficients[5:]):
            _, _, _, _, _, k4, k5, k6 = self.coefficients
            first = r2 / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        for row, focal, ideal, distorted in ((0, self.fx, x, u), (1, self.fy, y, v)):
            lens[row, 0] = focal * distorted
            lens[row, 1 + row] = 1
            lens[row, 3] = focal * ideal * first
            lens[row, 4] = lens[row, 3] * next_power
        return np.moveaxis(by_plane, (0, 1), (-2, -1)), np.moveaxis(
            lens, (0, 1), (-2, -1)
        )

    def to_dict(self) -> dict[str, object]:
        """Plain numbers for JSON; the model only of a fisheye."""
        model = {"model": self.model} if self.model == "fisheye" else {}
        numbers = {
            name: value for name, value in asdict(self).items() if name != "model"
        }
        return {**numbers, "distortion": list(self.distortion), **model}

    @classmethod
    def from_dict(cls, data: Mapping[str, object]) -> Self:
        """Inverse of `to_dict`; unknown keys are ignored, `distortion` is optional."""
        names = ("width", "height", "fx", "fy", "cx", "cy")
        numbers: dict[str, Any] = {
            name: _number(data.get(name), name) for name in names
        }
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

    def _distorted(
        self, x: Array, y: Array
    ) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        """Distorted points (u, v), and their derivatives du/dx, du/dy = dv/dx and dv/dy."""
        p1, p2 = (0.0, 0.0) if self.model == "fisheye" else self.coefficients[2:4]
        r2 = x * x + y * y
        radial, change = self._radial(r2)
        twice = 2 * change
        u = x * radial
        v = y * radial
        cross = x * y * twice
        a = radial + x * x * twice
        d = radial + y * y * twice
        if p1 or p2:
            u = u + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            v = v + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            cross = cross + 2 * (p1 * x + p2 * y)
            a = a + 2 * p1 * y + 6 * p2 * x
            d = d + 6 * p1 * y + 2 * p2 * x
        return (u, v), (a, cross, d)

    def _radial(self, r2: Array) -> tuple[Array, Array]:
        """Distorted over ideal radius, and its derivative by the ideal squared radius `r2`."""
        if self.model == "fisheye":
            k1, k2, k3, k4 = self.distortion
            ratio = _angle_per_radius(r2)
            t2 = np.arctan(np.sqrt(r2)) ** 2
            longer = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
            steeper = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            radial = ratio * longer
            change = (steeper / (1 + r2) - radial) / (2 * np.maximum(r2, 1e-8))
            return radial, np.where(r2 > 1e-8, change, k1 - 1 / 3)
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients
        above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        steeper = k1 + r2 * (2 * k2 + r2 * 3 * k3)
        if not (k4 or k5 or k6):
            return above, steeper
        below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        return radial, (steeper - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below

    def _angles(self, radii: Array) -> Array:
        """Angles of a fisheye at distorted radii (...); NaN outside its range."""
        k1, k2, k3, k4 = self.distortion
        radius = np.polynomial.Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])
        slope = radius.deriv()
        most = math.atan(self.widest)
        angles = np.minimum(radii, most)
        off = radius(angles) - radii
        for _ in range(50):  # Newton's method: a few steps but close to a fold
            if (np.abs(off) < _EXACT).all():
                break
            angles = np.clip(angles - off / np.maximum(slope(angles), 1e-6), 0, most)
            off = radius(angles) - radii
        return np.where(np.abs(off) < _EXACT, angles, np.nan)

    def _undistorted(self, distorted: Array) -> Array:
        if self.model == "fisheye":
            radii = np.linalg.norm(distorted, axis=-1, keepdims=True)
            return distorted * np.tan(self._angles(radii)) / np.maximum(radii, 1e-12)
        plane = distorted
        lost = np.ones(distorted.shape[:-1], bool)
        for _ in range(50):  # Newton's method: a few steps but close to `widest`
            far = np.sqrt((plane**2).sum(-1, keepdims=True))
            plane = plane * np.minimum(
                1, 0.999999 * self.widest / np.maximum(far, 1e-12)
            )
            at, (a, b, d) = self._distorted(plane[..., 0], plane[..., 1])
            u = at[0] - distorted[..., 0]
            v = at[1] - distorted[..., 1]
            lost = np.maximum(np.abs(u), np.abs(v)) > _EXACT
            if not lost.any():
                break
            step = (
                np.stack([d * u - b * v, a * v - b * u], -1)
                / (a * d - b * b)[..., None]
            )
            plane = plane - step
        return np.where(lost[..., None], np.nan, plane)


def _roots(coefficients: ArrayLike) -> list[float]:
    """Positive real roots of a polynomial, from its coefficients in ascending order."""
    roots = np.polynomial.polynomial.polyroots(
        np.trim_zeros(np.asarray(coefficients), "b")
    )
    return roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].tolist()


def _angle_per_radius(r2: Array) -> Array:
    """atan(r) / r of squared radii."""
    r = np.sqrt(np.maximum(r2, 1e-12))
    return np.arctan(r) / r


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"camera '{name}' is a number, got {value!r}")
    return float(value)
