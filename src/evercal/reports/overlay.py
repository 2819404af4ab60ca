"""Points and lines drawn over images; images are (H, W, 3) uint8 RGB."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evercal.recordings.images import encode_jpeg

Image = NDArray[np.uint8]

_NAN_COLOUR = (160, 160, 160)
_FRACTION_BITS = 4  # of a pixel, for OpenCV's drawing functions
_FONT = 0  # cv2.FONT_HERSHEY_SIMPLEX; OpenCV is imported inside functions only
_MARGIN = 6
_VECTOR_PX = 25.0
"""Length of long residual vectors as drawn, pixels."""
_VECTOR_COLOUR = (255, 140, 40)


def overlay_points(
    image: Image,
    pixels: ArrayLike,
    colours: ArrayLike,
    radius: float = 2.0,
    limits: tuple[float, float] | None = None,
    legend: str | None = None,
) -> Image:
    """Draw points over an image.

    Later points cover earlier ones. Values are drawn over a grey copy of the image. Points outside
    the image and points that are not finite are omitted. Pixels (n, 2) are x and y; 0 is the centre
    of the first pixel. Colours are (n, 3) uint8 RGB, or (n,) values for the viridis colour map,
    with NaN in grey. By default its limits are the 2nd and 98th percentile. The legend is the
    quantity and unit of the values.
    """
    import cv2

    points, colours = np.asarray(pixels, dtype=np.float64), np.asarray(colours)
    drawn = np.ascontiguousarray(image).copy()
    if colours.ndim == 1:
        values = colours.astype(np.float64)
        limits = limits or _limits(values)
        colours = colour_map(values, limits)
        drawn[:] = cv2.cvtColor(drawn, cv2.COLOR_RGB2GRAY)[..., None]
    edge = np.array([image.shape[1] - 0.5, image.shape[0] - 0.5]) + radius
    with np.errstate(invalid="ignore"):
        visible = np.flatnonzero(((points > -0.5 - radius) & (points < edge)).all(axis=1))
    centres = np.round(points[visible] * (1 << _FRACTION_BITS)).astype(int)
    size = round(radius * (1 << _FRACTION_BITS))
    for (x, y), colour in zip(centres.tolist(), colours[visible].tolist(), strict=True):
        cv2.circle(drawn, (x, y), size, colour, -1, cv2.LINE_AA, _FRACTION_BITS)
    if legend and limits is not None:
        _draw_legend(drawn, legend, limits)
    return drawn


def overlay_lines(
    image: Image,
    lines: Sequence[ArrayLike],
    colours: Sequence[tuple[int, int, int]],
    width: int = 2,
    dash: float | None = None,
    rims: bool = True,
) -> Image:
    """Draw lines over an image, solid ones with a white rim and dashed ones with a black rim.

    Lines are (n, 2) x and y; 0 is the centre of the first pixel. Points that are not finite
    interrupt the line. `dash` is the length of dashes and gaps in pixels; None draws solid lines.
    Many short lines are clearer without `rims`.
    """
    import cv2

    drawn = np.ascontiguousarray(image).copy()
    for line, colour in zip(lines, colours, strict=True):
        points = np.asarray(line, dtype=np.float64)
        # OpenCV uses 32-bit integers.
        points = np.where(np.abs(points) < 1e6, points, np.nan)
        pieces = [piece for piece in _finite_pieces(points) if len(piece) > 1]
        if dash is not None:
            pieces = [part for piece in pieces for part in _dashes(piece, dash)]
        fixed = [np.round(piece * (1 << _FRACTION_BITS)).astype(np.int32) for piece in pieces]
        rim = (255, 255, 255) if dash is None else (0, 0, 0)
        for ink, thickness in ((rim, width + 2), (colour, width))[0 if rims else 1 :]:
            cv2.polylines(drawn, fixed, False, ink, thickness, cv2.LINE_AA, _FRACTION_BITS)
    return drawn


def overlay_vectors(
    image: Image, pixels: NDArray[np.float64], vectors: NDArray[np.float64]
) -> tuple[Image, int]:
    """Draw residual vectors (n, 2) at pixels (n, 2); returns the factor of their length, too."""
    times = exaggeration(vectors)
    lines = np.stack([pixels, pixels + times * vectors], 1)
    colours = [_VECTOR_COLOUR] * len(lines)
    return overlay_lines(image, list(lines), colours, 1, rims=False), times


def exaggeration(vectors: NDArray[np.float64]) -> int:
    """Factor that makes residual vectors (n, 2) visible, the same for all: 1, 2, 5, 10, ..."""
    lengths = np.linalg.norm(vectors, axis=1)
    long = float(np.nanpercentile(lengths, 90)) if np.isfinite(lengths).any() else _VECTOR_PX
    factors = [1, 2, 5, 10, 20, 50, 100]
    return max([factor for factor in factors if factor * long <= _VECTOR_PX], default=1)


def encode_image(image: Image, kind: Literal["png", "jpg"] = "png") -> bytes:
    """Encode an image as PNG, or as JPEG, which is smaller but lossy."""
    import cv2

    if kind == "jpg":
        return encode_jpeg(image, quality=88)
    return cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()


def _finite_pieces(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Split a line (n, 2) at points that are not finite."""
    finite = np.isfinite(points).all(axis=1)
    starts = np.flatnonzero(np.diff(finite.astype(int), prepend=0)) if len(points) else []
    return [part for part in np.split(points, starts) if len(part) and np.isfinite(part[0]).all()]


def _dashes(points: NDArray[np.float64], length: float) -> list[NDArray[np.float64]]:
    """Every other piece of `length` pixels along a line (n, 2)."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    dashes = []
    for start in np.arange(0, along[-1], 2 * length):
        end = min(start + length, along[-1])
        stops = np.unique([start, *along[(along > start) & (along < end)], end])
        dashes.append(np.stack([np.interp(stops, along, points[:, i]) for i in (0, 1)], axis=1))
    return dashes


def _limits(values: NDArray[np.float64]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [2, 98]).tolist() if len(finite) else (0.0, 1.0)
    return low, high


def colour_map(values: NDArray[np.float64], limits: tuple[float, float]) -> Image:
    """Map values (n,) to (n, 3) RGB with viridis."""
    import cv2

    low, high = limits
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / max(high - low, 1e-12)
    steps = np.round(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    colours = np.full((len(values), 3), _NAN_COLOUR, np.uint8)
    if len(values):
        colours[finite] = cv2.applyColorMap(steps[:, None], cv2.COLORMAP_VIRIDIS)[finite, 0, ::-1]
    return colours


def _draw_legend(image: Image, text: str, limits: tuple[float, float]) -> None:
    """Draw a colour bar on white in the lower right corner."""
    import cv2

    scale = max(0.4, min(0.8, image.shape[1] / 1000))
    low, high = (f"{value:.3g}" for value in limits)
    (width, line), _ = cv2.getTextSize(f"{low}  {text}  {high}", _FONT, scale, 1)
    width, line = min(max(width, 120), image.shape[1] - 2 * _MARGIN), line + 6
    height = min(2 * line + 4, image.shape[0])
    if width < 20 or height < 2 * line:
        return
    panel = np.full((height, width + 8, 3), 255, np.uint8)
    ramp = np.linspace(*limits, num=width) if limits[1] > limits[0] else np.full(width, limits[0])
    panel[4 : line - 2, 4 : 4 + width] = colour_map(ramp, limits)
    right = cv2.getTextSize(high, _FONT, scale, 1)[0][0]
    middle = cv2.getTextSize(text, _FONT, scale, 1)[0][0]
    for label, x in ((low, 4), (text, 4 + (width - middle) // 2), (high, 4 + width - right)):
        cv2.putText(panel, label, (x, 2 * line - 3), _FONT, scale, (0, 0, 0), 1, cv2.LINE_AA)
    panel = panel[:, : image.shape[1]]
    image[-panel.shape[0] :, -panel.shape[1] :] = panel
