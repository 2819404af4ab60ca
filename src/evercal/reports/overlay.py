"""Landmarks, residuals and axes drawn over images; images are (H, W, 3) uint8 RGB."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from evercal.geometry import SE3, Camera, norms, resize_pixels
from evercal.typing import Array, Image, Pair

if TYPE_CHECKING:
    from evercal.localization.estimate import PoseEstimate
    from evercal.reports.inspected import LearnedLocalizer

Colour = tuple[int, int, int]

MAX_RESIDUAL_PX = 2.0
"""Upper end of the colour scale of residuals, pixels of the working image."""
PICTURE_PX = 640
"""Width of pictures in reports and videos."""
AXES_M = 0.1
"""Length of drawn axes, metres."""
_AXES_STEPS = 32
"""Straight pieces of a drawn axis, which distortion bends."""
_AXES = ((214, 39, 40), (44, 160, 44), (31, 95, 220))
"""x red, y green, z blue."""
_PALE_AXES = ((237, 158, 158), (160, 212, 160), (154, 183, 239))
"""The same of an older calibration."""
_NAN_COLOUR = (160, 160, 160)
"""Colour of a value that is not finite."""
_FRACTION_BITS = 4
"""Bits of a fraction of a pixel, for OpenCV's drawing functions."""
_FRACTIONS = 1 << _FRACTION_BITS
"""Fractions in a pixel."""
_FONT = 0
"""cv2.FONT_HERSHEY_SIMPLEX; OpenCV is imported inside functions only."""
_MARGIN = 6
"""Around the legend, pixels."""
_VECTORS = 12
"""Residual vectors side by side in an image, at most."""
_VECTOR_PX = 50.0
"""Length of long residual vectors as drawn, pixels."""
_VECTOR_COLOUR = (255, 140, 40)
"""Orange, RGB."""


class LandmarkPicture(NamedTuple):
    """An image with its landmarks."""

    image: Image
    """(h, w, 3) RGB."""
    landmarks: int
    """Number of landmarks."""
    summary: str
    """Their number and median residual; without landmarks, the reason."""


def draw_landmarks(
    image: Image,
    estimate: "PoseEstimate",
    localizer: "LearnedLocalizer",
    camera: Camera | None = None,
    base_from_camera: SE3 | None = None,
    width: int = PICTURE_PX,
) -> LandmarkPicture:
    """Resize an image and draw its landmarks, with lines from detections to projections.

    The camera is by default that of the estimate, else that of the scene; the pose that of the
    estimate. Residuals are in pixels of the image. Nothing is drawn without a pose or landmarks.
    """
    large = resized(image, width)
    pose = base_from_camera or estimate.base_from_camera
    pixels = estimate.pixels
    points = estimate.points_m
    located = estimate.base_from_camera is not None
    if not located or not pose or pixels is None or points is None:
        reason = estimate.reason or estimate.status.replace("_", " ")
        return LandmarkPicture(large, 0, reason)
    scene = next(s for s in localizer.contents.scenes if s.name == estimate.scene)
    whole = camera or estimate.camera or scene.adjusted_camera
    working = whole.short_side_resized(localizer.contents.short_side)
    map_from_camera = scene.frame.camera_among_points(pose)
    in_camera = map_from_camera.inverse().apply(points)
    errors = working.project(in_camera) - pixels
    enlarged = large.shape[0] / working.height
    image_scale = image.shape[0] / working.height
    lengths = norms(errors)
    residuals = image_scale * lengths
    largest = image_scale * MAX_RESIDUAL_PX
    centres = resize_pixels(pixels, enlarged)
    vectors = enlarged * errors
    drawn, times = draw_residuals(
        large,
        centres,
        vectors,
        residuals,
        largest,
    )
    median = np.nan
    if np.isfinite(residuals).any():
        median = float(np.nanmedian(residuals))
    count = len(residuals)
    words = f"{count} landmarks, median residual {median:.2f} px, lines {times} times as long"
    return LandmarkPicture(drawn, count, words)


def draw_residuals(
    image: Image, pixels: Array, vectors: Array, residuals: Array, largest: float
) -> tuple[Image, int]:
    """Draw detections (n, 2) and residual vectors (n, 2) over a grey copy of an image.

    Vectors are drawn of one detection in each part of the image. Detections that are not finite are
    omitted. `residuals` (n,) are those of the legend, in any
    unit of pixels, NaN without a projection. Returns the factor that enlarges the vectors, too.
    """
    import cv2

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    drawn = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    width = image.shape[1]
    cells = np.round(pixels * _VECTORS / width)
    chosen = np.unique(cells, axis=0, return_index=True)[1]
    vectors = vectors[chosen]
    times = exaggeration(vectors)
    starts = pixels[chosen]
    lines = np.stack([starts, starts + times * vectors], 1)
    inks = [_VECTOR_COLOUR] * len(lines)
    drawn = overlay_lines(drawn, lines, inks, 2)
    limits = (0.0, largest)
    radius = round(max(2.0, width / 180) * _FRACTIONS)
    visible = (np.abs(pixels) < 1e5).all(axis=1)
    fixed = np.round(pixels[visible] * _FRACTIONS)
    centres = fixed.astype(int).tolist()
    colours = colour_map(residuals, limits)[visible].tolist()
    for centre, colour in zip(centres, colours, strict=True):
        cv2.circle(
            drawn,
            centre,
            radius,
            colour,
            -1,
            cv2.LINE_AA,
            _FRACTION_BITS,
        )
    _draw_legend(drawn, "residual (px)", limits)
    return drawn, times


def overlay_lines(
    image: Image, lines: Sequence[Array] | Array, colours: Sequence[Colour], width: int
) -> Image:
    """Draw lines (n, 2) over an image; points that are not finite interrupt them."""
    import cv2

    drawn = np.ascontiguousarray(image).copy()
    for line, colour in zip(lines, colours, strict=True):
        # OpenCV uses 32-bit integers.
        small = np.abs(line) < 1e6
        valid = np.asarray(small.all(axis=1))
        finite = np.where(valid[:, None], line, 0)
        rounded = np.round(finite * _FRACTIONS)
        fixed = rounded.astype(np.int32)
        both_valid = valid[:-1] & valid[1:]
        starts = np.flatnonzero(both_valid)
        pieces = [fixed[start : start + 2] for start in starts]
        cv2.polylines(
            drawn,
            pieces,
            False,
            colour,
            width,
            cv2.LINE_AA,
            _FRACTION_BITS,
        )
    return drawn


def exaggeration(vectors: Array) -> int:
    """Factor that makes residual vectors (n, 2) visible, the same for all: 1, 2, 5, 10, ..."""
    lengths = norms(vectors)
    if not np.isfinite(lengths).any():
        return 1
    longest = float(np.nanpercentile(lengths, 90))
    for factor in (100, 50, 20, 10, 5, 2):
        if factor * longest <= _VECTOR_PX:
            return factor
    return 1


def colour_map(values: Array, limits: Pair) -> Image:
    """Map values (n,) to (n, 3) RGB with viridis; NaN is grey."""
    import cv2

    low, high = limits
    finite = np.isfinite(values)
    above = np.where(finite, values, low) - low
    share = above / max(high - low, 1e-12)
    steps = np.round(255 * np.clip(share, 0.0, 1.0))
    colours = np.full((len(values), 3), _NAN_COLOUR, np.uint8)
    if len(values):
        column = steps.astype(np.uint8)[:, None]
        bgr = cv2.applyColorMap(column, cv2.COLORMAP_VIRIDIS)
        colours[finite] = bgr[finite, 0, ::-1]
    return colours


def resized(image: Image, width: int) -> Image:
    """An image with another width and the same aspect ratio."""
    import cv2

    old_height, old_width = image.shape[:2]
    height = max(1, round(old_height * width / old_width))
    method = cv2.INTER_CUBIC
    if old_width > width:
        method = cv2.INTER_AREA
    other = cv2.resize(image, (width, height), interpolation=method)
    return np.asarray(other, np.uint8)


def _draw_legend(image: Image, text: str, limits: Pair) -> None:
    import cv2

    low, high = limits
    image_height, image_width = image.shape[:2]
    scale = max(0.4, min(0.8, image_width / 1000))
    words = f"{low:.3g}  {text}  {high:.3g}"
    (length, line), _ = cv2.getTextSize(words, _FONT, scale, 1)
    width = length + 2 * _MARGIN
    height = 2 * line + 3 * _MARGIN
    if width > image_width or height > image_height:
        return
    panel = image[-height:, -width:]
    panel[:] = 255
    values = np.linspace(low, high, num=length)
    rows = slice(_MARGIN, _MARGIN + line)
    panel[rows, _MARGIN:-_MARGIN] = colour_map(values, limits)
    left = image_width - width + _MARGIN
    origin = (left, image_height - _MARGIN)
    black = (0, 0, 0)
    cv2.putText(
        image,
        words,
        origin,
        _FONT,
        scale,
        black,
        1,
        cv2.LINE_AA,
    )


def origin_in_view(camera: Camera, camera_from_frame: SE3) -> tuple[Array, str]:
    """Project the origin of a frame: its pixel (2,), and where it lies if outside the image."""
    pixel = camera.project(camera_from_frame.translation_m)
    if camera_from_frame.translation_m[2] <= 0:
        return pixel, "behind the camera"
    corner = (camera.width - 0.5, camera.height - 0.5)
    if ((pixel > -0.5) & (pixel < corner)).all():
        return pixel, ""
    return pixel, "outside the image"


def axes_in_view(
    camera: Camera, camera_from_frame: SE3, length_m: float = AXES_M
) -> Array:
    """Project the axes of a frame: (3, n, 2) pixels along x, y and z; NaN where not visible."""
    along = np.linspace(0.0, length_m, _AXES_STEPS + 1)
    points = np.eye(3)[:, None] * along[:, None]
    return camera.project(camera_from_frame.apply(points))


def draw_axes(
    image: Image, camera: Camera, camera_from_frame: SE3, pale: bool = False
) -> Image:
    """Draw the axes of a frame into a copy of an image of any size.

    If the origin is not visible, the lower left corner shows the directions of the axes instead,
    unless they are pale.
    """
    import cv2

    height, width = image.shape[:2]
    camera = camera.resized(width, height)
    lines = axes_in_view(camera, camera_from_frame)
    thickness = max(2, round(width / 220))
    if pale:
        return overlay_lines(image, lines, _PALE_AXES, thickness)
    if origin_in_view(camera, camera_from_frame)[1]:
        length = 0.09 * min(width, height)
        rotation = camera_from_frame.rotation_matrix()
        directions = length * rotation[:2].T
        corner = np.array([2 * length, height - 2 * length])
        starts = np.zeros((3, 2))
        lines = corner + np.stack([starts, directions], 1)
    white = (255, 255, 255)
    drawn = overlay_lines(image, lines, [white] * 3, thickness + 2)
    drawn = overlay_lines(drawn, lines, _AXES, thickness)
    for letter, line, colour in zip("xyz", lines, _AXES, strict=True):
        along = line[-1] - line[0]
        end = line[0] + 1.15 * along
        if not (np.abs(end) < 1e5).all():
            continue
        x, y = end.round().astype(int).tolist()
        origin = (x - 5, y + 5)
        for ink, width_px in ((white, 5), (colour, 2)):
            cv2.putText(
                drawn,
                letter,
                origin,
                0,
                0.6,
                ink,
                width_px,
                cv2.LINE_AA,
            )
    return drawn
