"""Charts: panels with two axes, written by a template as SVG, or drawn into frames of a video."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from evercal.classes import frozen_arrays
from evercal.reports.overlay import overlay_lines
from evercal.typing import Array, Image, Size

Text = tuple[str, float, float, int]
"""Words, and the pixel on their base line that they lie right of (0), around (1) or left of (2)."""

INKS = {
    "text": ("#1b1f24", "#e6edf3"),
    "grid": ("#e4e8ec", "#262c34"),
    "blue": ("#0072B2", "#56B4E9"),
    "orange": ("#D55E00", "#E69F00"),
    "green": ("#1a7f37", "#4ac26b"),
    "red": ("#cf222e", "#ff7b72"),
}
"""Colours on light and on dark paper. Blue and orange, of Okabe and Ito, differ for all eyes."""
_GAP = (np.nan, np.nan)
"""Interrupts a line."""
_FINER = 4
"""Steps in a pixel of a frame."""


class Tick(NamedTuple):
    """A number at an axis."""

    value: float
    """In the unit of the axis."""
    pixels: float
    """Distance from the lower end of the axis."""
    words: str
    """The number as it is written."""


class Shape(NamedTuple):
    """What is drawn in a panel in one colour."""

    kind: Literal["line", "dots", "area", "stripes"]
    """An area has an outline, too. Stripes lie across the line, which looks hatched."""
    points: Array
    """(n, 2) in the units of the axes; NaN interrupts a line."""
    ink: str
    width: float = 1.0
    """Of a line or dot, pixels."""
    opacity: float = 1.0
    """Of dots, and inside of an area."""


@frozen_arrays
class Panel:
    """Shapes in a box with axes at the left and bottom; nothing is drawn outside."""

    size: Size
    """Width and height of the box, pixels."""
    limits: Array
    """(2, 2) lower and upper ends of both axes, in their units."""
    labels: tuple[str, str]
    """What the axes show, with the unit. An x axis without a label has no numbers."""
    shapes: Sequence[Shape]

    def pixels(self, points: Array) -> Array:
        """(n, 2) pixels in the box of points (n, 2); the upper left corner is (0, 0)."""
        x, y = ((points - self.limits[0]) / np.ptp(self.limits, axis=0) * self.size).T
        return np.column_stack([x, self.size[1] - y])

    def path(self, shape: Shape) -> str:
        """The points of a shape as a path of SVG."""
        places = self.pixels(shape.points).round(1).tolist()
        words = " ".join(f"{x:g},{y:g}" for x, y in places)
        path = ""
        if shape.kind == "dots":
            for word in words.split():
                path += f"M{word}h0"
            return path
        for piece in words.split("nan,nan"):
            if piece.strip():
                path += f"M{piece}"
        return path

    @property
    def drawn(self) -> list[Shape]:
        """The grid, the shapes, and the axes."""
        (x0, y0), (x1, y1) = self.limits
        lines = []
        for tick in self._ticks(0):
            lines += [(tick.value, y0), (tick.value, y1), _GAP]
        for tick in self._ticks(1):
            lines += [(x0, tick.value), (x1, tick.value), _GAP]
        points = np.array(lines).reshape(-1, 2)
        grid = Shape("line", points, "grid")
        corner = np.array([(x0, y1), (x0, y0), (x1, y0)])
        axes = Shape("line", corner, "text", 2.0)
        return [grid, *self.shapes, axes]

    @property
    def texts(self) -> list[Text]:
        """The numbers at the axes, and what these show."""
        width, height = self.size
        x, y = self.labels
        texts: list[Text] = []
        texts.append((y, -52, -12, 0))
        texts.append((x, width / 2, height + 40, 1))
        for tick in self._ticks(1):
            base_line = height - tick.pixels + 4
            texts.append((tick.words, -8, base_line, 2))
        if not x:
            return texts
        for tick in self._ticks(0):
            texts.append((tick.words, tick.pixels, height + 18, 1))
        return texts

    def _ticks(self, axis: int) -> list[Tick]:
        """Round numbers along an axis."""
        low, high = self.limits[:, axis].tolist()
        extent = high - low
        size = self.size[axis]
        most = min(max(size // 50, 5), 8)
        step = _round_step(extent / most)
        power = int(np.floor(np.log10(step) + 1e-9))
        digits = max(0, -power)
        first = np.ceil(low / step)
        last = np.floor(high / step)
        numbers = step * np.arange(first, last + 1)
        pixels = ((numbers - low) / extent * size).round(1)
        ticks = []
        for number, pixel in zip(numbers.tolist(), pixels.tolist(), strict=True):
            # Adding zero makes a positive zero of a negative one.
            words = f"{number + 0.0:.{digits}f}"
            # A minus sign is as wide as a digit.
            ticks.append(Tick(number, pixel, words.replace("-", "\N{MINUS SIGN}")))
        return ticks


def _round_step(coarse: float) -> float:
    """The smallest of 1, 2, 5, 10 ... that is not below a step."""
    power = 10.0 ** np.floor(np.log10(coarse))
    for factor in (1, 2, 5):
        if factor * power >= coarse:
            return power * factor
    return power * 10


Chart = tuple[list[Panel], str]
"""Panels side by side, or below each other where they are wide, and a caption."""


def rgb(ink: str) -> tuple[int, int, int]:
    """A colour on light paper."""
    red, green, blue = bytes.fromhex(INKS[ink][0][1:])
    return red, green, blue


def write(image: Image, text: Text, size: int = 13, ink: str = "text") -> None:
    """Write into an RGB image (h, w, 3), whose upper left corner is the text's; size in pixels."""
    import cv2

    words, x, y, align = text
    font = cv2.FontFace("sans")
    width = cv2.getTextSize(
        (0, 0),
        words,
        (0, 0),
        font,
        size,
        400,
    )[2]
    origin = (round(x - align * width / 2), round(y))
    cv2.putText(
        image,
        words,
        origin,
        rgb(ink),
        font,
        size,
        400,
    )


def paint(image: Image, panel: Panel, left: int, top: int) -> None:
    """Draw a panel into an RGB image (h, w, 3), the upper left corner of its box at a pixel.

    Of areas and stripes, lines are drawn.
    """
    import cv2

    width, height = panel.size
    large = np.full((_FINER * height, _FINER * width, 3), 255, np.uint8)
    for shape in panel.drawn:
        pixels = _FINER * panel.pixels(shape.points)
        thickness = round(_FINER * shape.width)
        colour = rgb(shape.ink)
        if shape.kind != "dots":
            large = overlay_lines(large, [pixels], [colour], thickness)
            continue
        pale = [255 + shape.opacity * (value - 255) for value in colour]
        for centre in pixels.round().astype(int).tolist():
            cv2.circle(
                large,
                centre,
                thickness // 2,
                pale,
                -1,
            )
    box = cv2.resize(large, panel.size, interpolation=cv2.INTER_AREA)
    bottom = top + height
    right = left + width
    image[top:bottom, left:right] = box
    for words, x, y, align in panel.texts:
        placed = (words, left + x, top + y, align)
        write(image, placed)
