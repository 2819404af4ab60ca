"""Images with the axes of a calibration drawn in, and the landmarks that were found in them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.calibration.from_images import map_digest
from evercal.errors import InputError
from evercal.recordings.images import read_image
from evercal.reports import overlay_points
from evercal.reports.frame_axes import (
    AxesInView,
    axes_in_view,
    close_up,
    draw_axes,
    draw_directions,
)
from evercal.reports.pictures import landmark_errors

if TYPE_CHECKING:
    from evercal.geometry import Camera
    from evercal.localization.localizer import Localizer

Image = NDArray[np.uint8]

MOST_IMAGES = 4
_CELL_PX = 640
_CLOSE_UP_PX = 480
_ASPECT_TOLERANCE = 0.01
_WORST_PX = 2.0
"""Reprojection error at the upper end of the colours, pixels of the working image."""


@dataclass(frozen=True)
class ImageFile:
    """An image that can be drawn into."""

    path: Path
    """A file that is there."""
    use: ImageUse | None
    """What became of it in the calibration; None where it is not one of its images."""


@dataclass(frozen=True, eq=False)
class View:
    """One image with what was drawn into it."""

    name: str
    """Of the image."""
    image: Image
    """(h, w, 3) uint8 RGB."""
    use: str
    """What became of it in the calibration."""
    landmarks: int | None = None
    """How many were found; None where nobody looked."""
    median_px: float | None = None
    """Median distance of the landmarks from where the calibration (or, for a camera on the
    gripper, the image's own pose) puts them, pixels of the image as it is."""
    status: str = ""
    """Why no landmarks were found."""


@dataclass(frozen=True, eq=False)
class Views:
    """All that the images of a calibration show."""

    views: tuple[View, ...] = ()
    """At most `MOST_IMAGES`."""
    axes: AxesInView | None = None
    """The axes of the parent frame, the same in every image; None without intrinsics."""
    older: AxesInView | None = None
    """Those of an older calibration."""
    close_up: Image | None = None
    """The origin of the parent frame in the first image, enlarged; None where it is not seen."""
    missing: tuple[str, ...] = ()
    """What could not be drawn, in sentences."""
    other_map: bool = False
    """Whether the store's map is not the one that the calibration was made with."""


def views_of(
    found: Calibration,
    images: Sequence[ImageFile],
    older: Calibration | None = None,
    localizer: "Localizer | None" = None,
    on_image: Callable[[], object] = lambda: None,
) -> Views:
    """Draws the calibration into some of its images.

    Args:
        found: the calibration.
        images: from `readable_images`.
        older: drawn pale and dashed beside it.
        localizer: of the store; finds the landmarks in the images.
        on_image: called after each image.
    """
    camera = found.camera
    if camera is None:
        reason = "the calibration holds no intrinsics, so nothing can be projected into an image."
        return Views(missing=(f"No pictures: {reason}",))
    axes = axes_in_view(camera, found.parent_from_child.inverse())
    before = None if older is None else axes_in_view(camera, older.parent_from_child.inverse())
    drawn, missing, near = [], [], None
    for file in images:
        path = file.path
        try:
            image = read_image(path)
        except InputError as error:
            missing.append(f"One picture is missing: {error}.")
            continue
        height, width = image.shape[:2]
        if abs(camera.width * height / (camera.height * width) - 1) > _ASPECT_TOLERANCE:
            missing.append(
                f"One picture is missing: {path} is {width}x{height}, which does not fit the"
                f" camera, {camera.width}x{camera.height}."
            )
            continue
        view = _view(found, file, image, localizer)
        with_axes = _with_axes(view.image, camera, found.parent_frame, axes, before)
        if not drawn:
            near = close_up(image, camera, axes, before, _CLOSE_UP_PX)
        drawn.append(replace(view, image=with_axes))
        on_image()
    changed = localizer is not None and _is_other_map(found, localizer)
    return Views(tuple(drawn), axes, before, near, tuple(missing), changed)


def readable_images(
    found: Calibration, folder: Path, given: Sequence[Path] = ()
) -> tuple[list[ImageFile], str]:
    """Which images to draw into.

    Args:
        found: the calibration.
        folder: where its file lies: relative names are looked up from here as well.
        given: files to take in place of those that it was made from.

    Returns:
        At most `MOST_IMAGES` files, spread over all, with one that was left out if there is any;
        and, where there is none, why in a sentence.
    """
    if given:
        uses = {Path(use.name).resolve(): use for use in found.images}
        files = [ImageFile(path, uses.get(path.resolve())) for path in given]
        return _spread(files, MOST_IMAGES), ""
    if not found.images:
        return [], "No pictures: the calibration names no images; give some with --images."
    used: list[ImageFile] = []
    lost: list[ImageFile] = []
    for use in found.images:
        path = next((p for p in (Path(use.name), folder / use.name) if p.is_file()), None)
        if path is not None:
            (used if use.used else lost).append(ImageFile(path, use))
    if not used and not lost:
        count = len(found.images)
        return [], (
            f"No pictures: none of the {count} images that it was made from can be read from here"
            f" (the first: {found.images[0].name}); give images with --images."
        )
    seen = lost[:1] if used else _spread(lost, MOST_IMAGES)
    return [*_spread(used, MOST_IMAGES - len(seen)), *seen], ""


def _spread(files: list[ImageFile], most: int) -> list[ImageFile]:
    if not files:
        return []
    chosen = np.linspace(0, len(files) - 1, min(most, len(files))).round().astype(int)
    return [files[i] for i in np.unique(chosen)]


def _view(found: Calibration, file: ImageFile, image: Image, localizer: "Localizer | None") -> View:
    """The image at the size of the page, with landmarks where a localizer finds them."""
    import cv2

    name, told = str(file.path), _told(file.use)
    scale = _CELL_PX / image.shape[1]
    size = (_CELL_PX, max(1, round(image.shape[0] * scale)))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(image, size, interpolation=way).astype(np.uint8)
    if localizer is None:
        return View(name, large, told)
    estimate = localizer.localize(image, found.camera)
    scene = found.source.get("scene")
    if scene is not None and estimate.scene not in (None, scene):
        return View(name, large, told, 0, None, f"it shows {estimate.scene}, not {scene}")
    # A camera on the gripper moves: its images are judged by their own poses.
    pose = found.parent_from_child if found.mount == "eye_to_hand" else None
    errors = landmark_errors(estimate, localizer, found.camera, pose)
    if errors is None:
        reason = estimate.reason or estimate.status.replace("_", " ")
        return View(name, large, told, 0, None, reason)
    own = image.shape[0] / errors.height
    at = (errors.pixels + 0.5) * (large.shape[0] / errors.height) - 0.5
    residual = own * errors.errors_px
    legend = "residual (px)"
    marked = overlay_points(large, at, residual, 3.5, (0.0, _WORST_PX * own), legend)
    finite = residual[np.isfinite(residual)]
    median = float(np.median(finite)) if len(finite) else None
    return View(name, marked, told, len(residual), median)


def _with_axes(
    image: Image, camera: "Camera", frame: str, axes: AxesInView, older: AxesInView | None
) -> Image:
    scale = image.shape[1] / camera.width
    drawn = draw_axes(image, axes.placed(scale), frame)
    if older is not None:
        drawn = draw_axes(drawn, older.placed(scale), older=True)
    return draw_directions(drawn, axes, frame) if axes.where else drawn


def _told(use: ImageUse | None) -> str:
    if use is None:
        return "not one of its images"
    return "used" if use.used else f"left out: {use.reason}"


def _is_other_map(found: Calibration, localizer: "Localizer") -> bool:
    """Whether the store's map is another than the calibration was made with, if that is known."""
    scene, digest = found.source.get("scene"), found.source.get("map")
    if digest is None or scene not in localizer.scenes:
        return digest is not None
    return map_digest(localizer, str(scene)) != digest
