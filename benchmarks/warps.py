"""Images of the packaged rooms that no camera in the room makes: mirrored, squeezed, bent, mixed.

Another camera at the same place makes some of them (a crop, a magnified image, a rotated one). The
true position is that of the untouched image for all; of two mixed images either one is right.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from benchmarks.accuracy import wrong
from benchmarks.rows import Row, median_of, save
from evercal.geometry import Camera
from evercal.localization.parallel import in_parallel
from evercal.map import Map
from evercal.recordings.frame import Frame
from evercal.recordings.samples import sample_rooms
from evercal.typing import Array

Shift = Callable[[Array, Array], tuple[Array, Array]]
"""From pixels (h, w) of a warped image to those of the image, both by column and row from the
middle, in halves of the width."""
Image = np.ndarray
"""uint8, shape (h, w, 3)."""
Warp = Callable[[Image], Image]
_FOCAL = 262.5 / 160
"""Focal length of the rooms' camera, in halves of the width."""


def run(
    out: Path = Path("runs/warps.csv"),
    images: int = 20,
    stated: Literal["none", "the recording's"] = "none",
    only: tuple[str, ...] = (),
    rooms: Path | None = None,
) -> None:
    """Locate warped test images of the packaged rooms.

    Args:
        out: File of rows to write.
        images: Test images of each room.
        stated: Camera that is stated.
        only: Names of warps; default all.
        rooms: Map of the rooms, in this order; default one that is learned.
    """
    with tempfile.TemporaryDirectory() as scratch:
        store = rooms or Path(scratch) / "rooms"
        learned = Map.open(store)
        frames: list[Frame] = []
        for room in sample_rooms():
            if rooms is None:
                learned.learn(room.scene)
            step = len(room.scene.test) // images
            frames += room.scene.test[::step][:images]
        rows = []
        for name in only or (*WARPS, *MIXED):
            camera = frames[0].camera if stated == "the recording's" else None
            rows.append({"warp": name, **_row(learned, frames, name, camera)})
            print(rows[-1], flush=True)
    save(out, rows, {"images": images, "stated": stated})


def _row(
    learned: Map, frames: Sequence[Frame], name: str, camera: Camera | None
) -> Row:
    def located(index: int) -> tuple[str, str, float, float]:
        frame = frames[index]
        # The other image is of another room, or a near one of the same.
        other = frames[(index + MIXED.get(name, (0,))[0]) % len(frames)]
        image = frame.read_image()
        if name in MIXED:
            image = MIXED[name][1](image, other.read_image())
        else:
            image = WARPS[name](image)
        stated = camera
        if stated is not None and not stated.fits(image.shape[1], image.shape[0]):
            stated = None
        answer = learned.localize(image, stated)
        pose = answer.uncertain_pose
        if pose is None:
            return answer.status, answer.reason, np.nan, np.nan
        errors = []
        for true in (frame, other):
            assert true.base_from_camera is not None
            off = pose.pose.translation_m - true.base_from_camera.translation_m
            squared = off @ np.linalg.solve(pose.covariance[:3, :3], off)
            errors.append((1000 * float(np.linalg.norm(off)), float(squared)))
        return answer.status, "", *min(errors)

    answers = list(in_parallel(located, range(len(frames))))
    mm = np.array([answer[2] for answer in answers])
    squared = np.array([answer[3] for answer in answers])
    words = [answer[1] for answer in answers if answer[1]]
    kinds = Counter(answer[0] for answer in answers)
    ok = np.isfinite(mm)
    return {
        "images": len(frames),
        "ok": kinds["ok"],
        "wrong": int(wrong(mm, squared).sum()),
        "median_mm": median_of(mm[ok]) if ok.any() else np.nan,
        "inside_95": 100 * float((squared[ok] < 7.815).mean()) if ok.any() else np.nan,
        "statuses": ", ".join(f"{n} {kind}" for kind, n in kinds.most_common()),
        "reason": Counter(words).most_common(1)[0][0] if words else "",
    }


def _warped(shift: Shift) -> Warp:
    """The warp by a shift of pixels."""

    def warp(image: Image) -> Image:
        height, width = image.shape[:2]
        half = width / 2
        rows, columns = np.mgrid[:height, :width]
        x = (columns - (width - 1) / 2) / half
        y = (rows - (height - 1) / 2) / half
        x, y = shift(x, y)
        column = (half * x + (width - 1) / 2).astype(np.float32)
        row = (half * y + (height - 1) / 2).astype(np.float32)
        return cv2.remap(
            image, column, row, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE
        )

    return warp


def _linear(a: float, b: float, c: float, d: float) -> Warp:
    return _warped(lambda x, y: (a * x + b * y, c * x + d * y))


def _oblique(right: float, down: float) -> Warp:
    """A photograph of the picture from one side; `right` and `down` are its perspective."""

    def shift(x: Array, y: Array) -> tuple[Array, Array]:
        # It is seen from half of its width, turned by this angle; magnified to fill the image.
        scale = 1 - abs(right) - abs(down)
        depth = (1 + right * x + down * y) / scale
        return x * np.sqrt(1 - right**2) / depth, y * np.sqrt(1 - down**2) / depth

    return _warped(shift)


def _radial(k1: float) -> Warp:
    def shift(x: Array, y: Array) -> tuple[Array, Array]:
        factor = (1 + k1 * (x**2 + y**2)) / (1 + max(k1, 0) * 1.5625)
        return x * factor, y * factor

    return _warped(shift)


def _rows(by: Callable[[Array], Array]) -> Warp:
    """Rows moved to the right, by a function of the row."""
    return _warped(lambda x, y: (x + by(y), y))


def _px(px: float) -> float:
    return px / 160


def _turning(px: float, axis: Array) -> Warp:
    """Rolling shutter of a camera that turns about an axis: by up to `px` at the last row."""

    def shift(x: Array, y: Array) -> tuple[Array, Array]:
        turn = _px(px) / 0.75 * y / _FOCAL
        right = turn * (axis[1] * (_FOCAL + x * x / _FOCAL) + axis[0] * x * y / _FOCAL)
        down = turn * (axis[0] * (_FOCAL + y * y / _FOCAL) + axis[1] * x * y / _FOCAL)
        # Of a roll, the corner moves by as many pixels.
        roll = _FOCAL * turn * axis[2]
        return x + right - roll * y, y + down + roll * x

    return _warped(shift)


def _bulge(x: Array, y: Array) -> tuple[Array, Array]:
    factor = 1 - 0.1 * np.exp(-((x - 0.3) ** 2 + (y + 0.1) ** 2) / (2 * 0.25**2))
    return 0.3 + (x - 0.3) * factor, -0.1 + (y + 0.1) * factor


def _cylinder(x: Array, y: Array) -> tuple[Array, Array]:
    """A panorama: columns are angles."""
    scale = 0.87
    return scale * _FOCAL * np.tan(x / _FOCAL), scale * y / np.cos(x / _FOCAL)


def _right_half_moved(x: Array, y: Array) -> tuple[Array, Array]:
    return x, y + _px(10) * (x > 0)


def _interlaced(image: Image) -> Image:
    moved = image.copy()
    moved[1::2] = np.roll(moved[1::2], 3, 1)
    return moved


def _jittered(image: Image) -> Image:
    rng = np.random.default_rng(0)
    steps = rng.normal(0, 1.0, len(image)).astype(np.float32)
    columns = np.arange(image.shape[1], dtype=np.float32)
    rows = np.arange(len(image), dtype=np.float32)
    x = columns[None, :] + steps[:, None]
    y = np.broadcast_to(rows[:, None], x.shape).copy()
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, None, cv2.BORDER_REPLICATE)


def _letterboxed(image: Image) -> Image:
    """The whole image at three quarters of its size, black beside it."""
    height, width = image.shape[:2]
    small = cv2.resize(image, (3 * width // 4, 3 * height // 4), None, 0, 0, 3)
    framed = np.zeros_like(image)
    top = height // 8
    left = width // 8
    framed[top : top + len(small), left : left + small.shape[1]] = small
    return framed


def _crop(image: Image) -> Image:
    """A part of the image off its middle, stated as a whole one."""
    height, width = image.shape[:2]
    part = image[height // 5 :, : 4 * width // 5]
    return cv2.resize(part, (width, height), None, 0, 0, cv2.INTER_CUBIC)


def _cut(image: Image) -> Image:
    height, width = image.shape[:2]
    return np.ascontiguousarray(image[: 3 * height // 4, width // 4 :])


def _on_screen(image: Image) -> Image:
    """An oblique photograph of a screen: moire, a glow and a dark frame."""
    seen = _oblique(0.06, 0.03)(image).astype(np.float64)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    moire = 1 + 0.08 * np.sin(0.9 * columns + 0.05 * rows) * np.sin(0.8 * rows)
    seen = 20 + 0.85 * seen * moire[..., None]
    seen[:8] = seen[-8:] = seen[:, :8] = seen[:, -8:] = 15
    return np.clip(seen, 0, 255).astype(np.uint8)


def _halves(image: Image, other: Image) -> Image:
    mixed = image.copy()
    half = image.shape[1] // 2
    mixed[:, half:] = other[:, half:]
    return mixed


def _blended(image: Image, other: Image) -> Image:
    return cv2.addWeighted(image, 0.5, other, 0.5, 0)


def _in_picture(image: Image, other: Image) -> Image:
    mixed = image.copy()
    height, width = image.shape[:2]
    small = cv2.resize(other, (width // 2, height // 2), None, 0, 0, cv2.INTER_AREA)
    mixed[-len(small) :, -small.shape[1] :] = small
    return mixed


def _mirrored(image: Image) -> Image:
    return np.ascontiguousarray(image[:, ::-1])


def _turned(deg: float) -> Warp:
    cosine = np.cos(np.deg2rad(deg))
    sine = np.sin(np.deg2rad(deg))
    return _linear(cosine, -sine, sine, cosine)


_AXIS = np.array([0.7, 0.6, 0.4])
WARPS: dict[str, Warp] = {
    "untouched": lambda image: image,
    "mirrored": _mirrored,
    "mirrored upside down": lambda image: np.ascontiguousarray(image[::-1]),
    "mirrored, turned by 3 deg": lambda image: _turned(3)(_mirrored(image)),
    "squeezed to 90 % of the width": _linear(0.9, 0, 0, 1),
    "squeezed to 95 % of the height": _linear(1, 0, 0, 0.95),
    "squeezed to 98 % of the height": _linear(1, 0, 0, 0.98),
    "squeezed to 99 % of the width": _linear(0.99, 0, 0, 1),
    "4:3 shown as 16:9": lambda image: cv2.resize(image, (320, 180), None, 0, 0, 3),
    "oblique photograph": _oblique(0.3, 0.15),
    "slightly oblique photograph": _oblique(0.06, 0.03),
    "photograph of a screen": _on_screen,
    "rows sheared by 6 px": _rows(lambda y: _px(4) * y),
    "rows sheared by 15 px": _rows(lambda y: _px(10) * y),
    "rolling shutter 1 px": _turning(1, _AXIS),
    "rolling shutter 2 px": _turning(2, _AXIS),
    "rolling shutter 3 px": _turning(3, _AXIS),
    "rolling shutter, pan 3 px": _turning(3, np.array([0.0, 1.0, 0.0])),
    "rolling shutter, tilt 3 px": _turning(3, np.array([1.0, 0.0, 0.0])),
    "rolling shutter, roll 3 px": _turning(3, np.array([0.0, 0.0, 1.0])),
    "rows on a parabola of 4 px": _rows(lambda y: _px(4) * (y / 0.75) ** 2),
    "rows on waves of 3 px": _rows(lambda y: _px(3) * np.sin(12 * y)),
    "rows jittered by 1 px": _jittered,
    "interlaced, 3 px apart": _interlaced,
    "half of it moved by 10 px": _warped(_right_half_moved),
    "local bulge of 10 %": _warped(_bulge),
    "barrel": _radial(0.1),
    "pincushion": _radial(-0.08),
    "decentred lens": _warped(
        lambda x, y: (x + 0.01 * (3 * x * x + y * y), y + 0.02 * x * y)
    ),
    "cylinder": _warped(_cylinder),
    "magnified 1.2 times": _linear(1 / 1.2, 0, 0, 1 / 1.2),
    "shifted by a stabiliser": _warped(lambda x, y: (x + _px(6), y - _px(4))),
    "turned by 5 deg": _turned(5),
    "crop shown as whole": _crop,
    "cut": _cut,
    "letterboxed": _letterboxed,
}
"""Warps of one image, by name."""
MIXED: dict[str, tuple[int, Callable[[Image, Image], Image]]] = {
    "halves of neighbours": (1, _halves),
    "halves of two rooms": (20, _halves),
    "two neighbours blended": (1, _blended),
    "two rooms blended": (20, _blended),
    "picture in picture": (3, _in_picture),
}
"""Mixtures of two images: how many images later the other one is, and how they are mixed."""
