"""Points and lines on photographs, and photographs side by side; images are (H, W, 3) uint8 RGB."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.uint8]

_NOT_A_NUMBER = (160, 160, 160)
_FRACTION_BITS = 4  # of a pixel, for OpenCV's drawing
_MARGIN = 6


def overlay_points(
    image: Image,
    pixels: ArrayLike,
    colours: ArrayLike,
    radius: float = 2.0,
    limits: tuple[float, float] | None = None,
    legend: str | None = None,
) -> Image:
    """Draws points over an image: scene points at an estimated pose, coloured by depth or error.

    Later points cover earlier ones, so sort by depth, far first, to see what lies in front. Below
    values the photograph turns grey, so that all colour is theirs. Points outside the image or at
    pixels that are not finite are left out.

    Args:
        image: (H, W, 3) uint8 RGB; not changed.
        pixels: (n, 2) x and y, where 0 is the centre of the first pixel.
        colours: (n, 3) uint8 RGB, or (n,) values for a colour map that the colour-blind can read,
            dark blue for low and yellow for high; what is not finite is grey.
        radius: Pixels.
        limits: Values at the ends of the map; from the values' 2nd to 98th percentile if left out.
            Give them to compare images.
        legend: What the values are, to be written below a colour bar; none if left out.

    Returns:
        A new image of the same size.

    Raises:
        ValueError: Shapes that do not belong together, or a legend without values.
    """
    import cv2

    _check_image(image)
    at, given = np.asarray(pixels, dtype=np.float64), np.asarray(colours)
    if at.ndim != 2 or at.shape[1] != 2:
        raise ValueError(f"pixels are (n, 2), got {at.shape}")
    if given.shape not in ((len(at),), (len(at), 3)) or (legend and given.ndim == 2):
        raise ValueError(
            f"colours of {len(at)} points are ({len(at)}, 3) RGB or ({len(at)},) values, and a"
            f" legend takes values; got {given.shape}"
        )
    drawn = np.ascontiguousarray(image).copy()
    if given.ndim == 1:
        limits = limits or _limits(given.astype(np.float64))
        given = _coloured(given.astype(np.float64), limits)
        drawn[:] = cv2.cvtColor(drawn, cv2.COLOR_RGB2GRAY)[..., None]
    edge = np.array([image.shape[1] - 0.5, image.shape[0] - 0.5]) + radius
    with np.errstate(invalid="ignore"):
        visible = np.flatnonzero(((at > -0.5 - radius) & (at < edge)).all(axis=1))
    centres = np.round(at[visible] * (1 << _FRACTION_BITS)).astype(int)
    size = round(radius * (1 << _FRACTION_BITS))
    for (x, y), colour in zip(centres.tolist(), given[visible].tolist(), strict=True):
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
) -> Image:
    """Draws lines over an image: the axes of a frame, say.

    Whole lines have a white rim and dashed ones a black one, so that they stand out on any ground
    and can be told apart where they lie together.

    Args:
        image: (H, W, 3) uint8 RGB; not changed.
        lines: (n, 2) x and y of each, where 0 is the centre of the first pixel; a line has a gap
            where a point is not finite.
        colours: RGB, one for each line.
        width: Pixels.
        dash: Length of dashes and of the gaps between them, pixels; None for whole lines.

    Returns:
        A new image of the same size.

    Raises:
        ValueError: Shapes that do not belong together.
    """
    import cv2

    _check_image(image)
    drawn = np.ascontiguousarray(image).copy()
    for line, colour in zip(lines, colours, strict=True):
        points = np.asarray(line, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"a line is (n, 2) pixels, got {points.shape}")
        # OpenCV counts in 32-bit integers: what is further off than this is not on any screen.
        points = np.where(np.abs(points) < 1e6, points, np.nan)
        pieces = [piece for piece in _unbroken(points) if len(piece) > 1]
        if dash is not None:
            pieces = [part for piece in pieces for part in _dashes(piece, dash)]
        whole = [np.round(piece * (1 << _FRACTION_BITS)).astype(np.int32) for piece in pieces]
        rim = (255, 255, 255) if dash is None else (0, 0, 0)
        for ink, thickness in ((rim, width + 2), (colour, width)):
            cv2.polylines(drawn, whole, False, ink, thickness, cv2.LINE_AA, _FRACTION_BITS)
    return drawn


def _unbroken(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The stretches of a line (n, 2) in which every point is finite."""
    finite = np.isfinite(points).all(axis=1)
    starts = np.flatnonzero(np.diff(finite.astype(int), prepend=0)) if len(points) else []
    return [part for part in np.split(points, starts) if len(part) and np.isfinite(part[0]).all()]


def _dashes(points: NDArray[np.float64], length: float) -> list[NDArray[np.float64]]:
    """Every other stretch of a length along a line (n, 2), pixels."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    found = []
    for start in np.arange(0, along[-1], 2 * length):
        end = min(start + length, along[-1])
        at = np.unique([start, *along[(along > start) & (along < end)], end])
        found.append(np.stack([np.interp(at, along, points[:, i]) for i in (0, 1)], axis=1))
    return found


def contact_sheet(
    images: Sequence[Image],
    columns: int,
    captions: Sequence[str] | None = None,
    cell_width: int | None = None,
) -> Image:
    """Images side by side on white, each with its caption below.

    Args:
        images: At least one, of any sizes; each is scaled to fit its cell and centred in it.
        columns: How many in a row.
        captions: One each; cut to the width of the cell. Letters outside ASCII become `?`.
        cell_width: Pixels; that of the widest image if left out.

    Raises:
        ValueError: No images, no columns, or a number of captions other than that of images.
    """
    if not images or columns < 1 or (captions is not None and len(captions) != len(images)):
        raise ValueError(
            f"a contact sheet takes images, at least one column and a caption for each image; got"
            f" {len(images)} images, {columns} columns and {captions and len(captions)} captions"
        )
    for image in images:
        _check_image(image)
    width = cell_width or max(image.shape[1] for image in images)
    scale = max(0.4, min(1.0, width / 500))
    line = round(30 * scale) if captions is not None else 0
    # No taller than a portrait photograph, however odd an image is.
    fitted = [_fitted(image, width, round(1.34 * width)) for image in images]
    columns = min(columns, len(images))
    total = columns * (width + _MARGIN) + _MARGIN
    sheet = [np.full((_MARGIN, total, 3), 255, np.uint8)]
    for first in range(0, len(images), columns):
        row = range(first, min(first + columns, len(images)))
        height = max(len(fitted[i]) for i in row)
        strip = np.full((height + line + _MARGIN, total, 3), 255, np.uint8)
        for i in row:
            left = _MARGIN + (i - first) * (width + _MARGIN)
            rows, across = fitted[i].shape[:2]
            y, x = (height - rows) // 2, left + (width - across) // 2
            strip[y : y + rows, x : x + across] = fitted[i]
            if captions is not None:
                _write(strip[height : height + line, left : left + width], captions[i], scale)
        sheet.append(strip)
    return np.concatenate(sheet)


def encode_image(image: Image, kind: Literal["png", "jpg"] = "png") -> bytes:
    """The bytes of an image file; `jpg` is smaller for photographs and not exact."""
    import cv2

    _check_image(image)
    parameters = [cv2.IMWRITE_JPEG_QUALITY, 88] if kind == "jpg" else []
    done, data = cv2.imencode(f".{kind}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), parameters)
    assert done, "OpenCV encodes any 8-bit image"
    return data.tobytes()


def _check_image(image: Image) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
        raise ValueError(f"an image is (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}")


def _limits(values: NDArray[np.float64]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = np.percentile(finite, [2, 98])
    return float(low), float(high)


def _coloured(values: NDArray[np.float64], limits: tuple[float, float]) -> Image:
    """(n, 3) RGB from OpenCV's copy of viridis."""
    import cv2

    low, high = limits
    finite = np.isfinite(values)
    share = (np.where(finite, values, low) - low) / max(high - low, 1e-12)
    steps = np.round(255 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    colours = np.full((len(values), 3), _NOT_A_NUMBER, np.uint8)
    if len(values):
        colours[finite] = cv2.applyColorMap(steps[:, None], cv2.COLORMAP_VIRIDIS)[finite, 0, ::-1]
    return colours


def _draw_legend(image: Image, text: str, limits: tuple[float, float]) -> None:
    """A colour bar on white in the lower right corner."""
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
    panel[4 : line - 2, 4 : 4 + width] = _coloured(ramp, limits)
    right = cv2.getTextSize(high, _FONT, scale, 1)[0][0]
    middle = cv2.getTextSize(text, _FONT, scale, 1)[0][0]
    for words, x in ((low, 4), (text, 4 + (width - middle) // 2), (high, 4 + width - right)):
        cv2.putText(panel, words, (x, 2 * line - 3), _FONT, scale, (0, 0, 0), 1, cv2.LINE_AA)
    panel = panel[:, : image.shape[1]]
    image[-panel.shape[0] :, -panel.shape[1] :] = panel


_FONT = 0  # cv2.FONT_HERSHEY_SIMPLEX, without importing OpenCV here


def _fitted(image: Image, width: int, height: int) -> Image:
    import cv2

    scale = min(width / image.shape[1], height / image.shape[0])
    size = max(1, math.floor(image.shape[1] * scale)), max(1, math.floor(image.shape[0] * scale))
    if size == (image.shape[1], image.shape[0]):
        return image
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=way), dtype=np.uint8)


def _write(cell: Image, text: str, scale: float) -> None:
    """One line of text, cut to the cell's width."""
    import cv2

    text = text.encode("ascii", "replace").decode()
    size = 0.7 * scale

    def fits(words: str) -> bool:
        return cv2.getTextSize(words, _FONT, size, 1)[0][0] <= cell.shape[1]

    if not fits(text):
        while text and not fits(text + "..."):
            text = text[:-1]
        text += "..."
    drawn = cell.copy()
    cv2.putText(drawn, text, (0, round(0.7 * len(cell))), _FONT, size, (0, 0, 0), 1, cv2.LINE_AA)
    cell[:] = drawn
