"""Points and lines drawn over images; images are (H, W, 3) uint8 RGB."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
Colour = tuple[int, int, int]

_NAN_COLOUR = (160, 160, 160)
_FRACTION_BITS = 4  # of a pixel, for OpenCV's drawing functions
_FONT = 0  # cv2.FONT_HERSHEY_SIMPLEX; OpenCV is imported inside functions only
_MARGIN = 6
_VECTOR_PX = 25.0
"""Length of long residual vectors as drawn, pixels."""
_VECTOR_COLOUR = (255, 140, 40)


def draw_residuals(
    image: Image, pixels: Array, vectors: Array, residuals: Array, largest: float
) -> tuple[Image, int]:
    """Draw points and residual vectors over a grey copy of an image.

    Args:
        image: (H, W, 3).
        pixels: (n, 2) detections, x and y; 0 is the centre of the first pixel.
        vectors: (n, 2) from detections to projections, pixels of the image.
        residuals: (n,) of the legend, any unit of pixels; NaN without a projection.
        largest: Upper end of the colour scale.

    Returns:
        The image, and the factor by which the vectors are exaggerated.
    """
    drawn = overlay_points(image, pixels, residuals, (0.0, largest), "residual (px)")
    times = exaggeration(vectors)
    lines = np.stack([pixels, pixels + times * vectors], 1)
    return overlay_lines(drawn, list(lines), [_VECTOR_COLOUR] * len(lines), 1), times


def overlay_points(
    image: Image, pixels: Array, values: Array, limits: tuple[float, float], legend: str
) -> Image:
    """Draw points (n, 2) over a grey copy of an image, coloured by values (n,).

    Later points cover earlier ones; points that are not finite are omitted.
    """
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    drawn = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    visible = (np.abs(pixels) < 1e5).all(axis=1)
    centres = np.round(pixels[visible] * (1 << _FRACTION_BITS)).astype(int)
    size = round(max(2.0, image.shape[1] / 180) * (1 << _FRACTION_BITS))
    colours = colour_map(values, limits)[visible]
    for centre, colour in zip(centres.tolist(), colours.tolist(), strict=True):
        cv2.circle(drawn, centre, size, colour, -1, cv2.LINE_AA, _FRACTION_BITS)
    _draw_legend(drawn, legend, limits)
    return drawn


def overlay_lines(
    image: Image, lines: Sequence[Array], colours: Sequence[Colour], width: int = 2
) -> Image:
    """Draw lines (n, 2) over an image; points that are not finite interrupt them."""
    import cv2

    drawn = np.ascontiguousarray(image).copy()
    for line, colour in zip(lines, colours, strict=True):
        # OpenCV uses 32-bit integers.
        valid = np.asarray((np.abs(line) < 1e6).all(axis=1))
        fixed = np.round(np.where(valid[:, None], line, 0) * (1 << _FRACTION_BITS)).astype(np.int32)
        pieces = [fixed[i : i + 2] for i in np.flatnonzero(valid[:-1] & valid[1:])]
        cv2.polylines(drawn, pieces, False, colour, width, cv2.LINE_AA, _FRACTION_BITS)
    return drawn


def exaggeration(vectors: Array) -> int:
    """Factor that makes residual vectors (n, 2) visible, the same for all: 1, 2, 5, 10, ..."""
    lengths = np.linalg.norm(vectors, axis=1)
    long = float(np.nanpercentile(lengths, 90)) if np.isfinite(lengths).any() else _VECTOR_PX
    factors = [1, 2, 5, 10, 20, 50, 100]
    return max([factor for factor in factors if factor * long <= _VECTOR_PX], default=1)


def colour_map(values: Array, limits: tuple[float, float]) -> Image:
    """Map values (n,) to (n, 3) RGB with viridis; NaN is grey."""
    import cv2

    low, high = limits
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / max(high - low, 1e-12)
    steps = np.round(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    colours = np.full((len(values), 3), _NAN_COLOUR, np.uint8)
    if len(values):
        colours[finite] = cv2.applyColorMap(steps[:, None], cv2.COLORMAP_VIRIDIS)[finite, 0, ::-1]
    return colours


def resized(image: Image, width: int) -> Image:
    """An image with another width and the same aspect ratio."""
    import cv2

    height = max(1, round(image.shape[0] * width / image.shape[1]))
    method = cv2.INTER_AREA if image.shape[1] > width else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, (width, height), interpolation=method), np.uint8)


def _draw_legend(image: Image, text: str, limits: tuple[float, float]) -> None:
    """Draw a colour bar on white in the lower right corner, if there is room."""
    import cv2

    scale = max(0.4, min(0.8, image.shape[1] / 1000))
    words = f"{limits[0]:.3g}  {text}  {limits[1]:.3g}"
    (width, line), _ = cv2.getTextSize(words, _FONT, scale, 1)
    width, height = width + 2 * _MARGIN, 2 * line + 3 * _MARGIN
    if width > image.shape[1] or height > image.shape[0]:
        return
    panel = image[-height:, -width:]
    panel[:] = 255
    ramp = colour_map(np.linspace(*limits, num=width - 2 * _MARGIN), limits)
    panel[_MARGIN : _MARGIN + line, _MARGIN:-_MARGIN] = ramp
    at = (image.shape[1] - width + _MARGIN, image.shape[0] - _MARGIN)
    cv2.putText(image, words, at, _FONT, scale, (0, 0, 0), 1, cv2.LINE_AA)
