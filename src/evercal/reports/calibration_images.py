"""Images of a calibrated camera with the axes of the parent frame and the landmarks drawn in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.errors import InputError
from evercal.geometry import Camera, resize_pixels
from evercal.recordings.images import read_image
from evercal.reports.board_views import BoardSeen
from evercal.reports.frame_axes import (
    AxesInView,
    axes_in_view,
    close_up,
    draw_axes,
    draw_directions,
)
from evercal.reports.overlay import overlay_points, overlay_vectors
from evercal.reports.pictures import draw_residuals, landmark_errors
from evercal.reports.scene.side_views import Surroundings

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedLocalizer

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

MAX_IMAGES = 4
_WIDTH_PX = 640
_CLOSE_UP_PX = 480
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class ImageFile:
    """An image of the camera."""

    path: Path
    """An existing file."""
    use: ImageUse | None
    """Its entry in the calibration; None for other images."""


@dataclass(frozen=True, eq=False)
class AnnotatedImage:
    """One image with overlays."""

    name: str
    """Path of the image."""
    image: Image
    """(h, w, 3) uint8 RGB."""
    summary: str
    """Use in the calibration and number of landmarks, or the reason for their absence."""
    landmarks: int | None = None
    """Number of detected landmarks; None without a store."""


@dataclass(frozen=True, eq=False)
class AnnotatedImages:
    """The images of a calibration with overlays."""

    images: tuple[AnnotatedImage, ...] = ()
    """At most `MAX_IMAGES`."""
    axes: AxesInView | None = None
    """Axes of the parent frame, the same in every image; None without intrinsics."""
    older_axes: AxesInView | None = None
    """Axes according to an older calibration."""
    close_up: Image | None = None
    """The origin of the parent frame in the first image, enlarged; None if it is not visible."""
    missing: tuple[str, ...] = ()
    """Sentences about overlays that are not possible."""
    other_map: bool = False
    """Whether the map in the store differs from the map of the calibration."""
    surroundings: Surroundings = field(default_factory=Surroundings)
    """The map around a fixed camera; empty without a store."""

    @property
    def landmarks(self) -> bool:
        """Whether landmarks were drawn."""
        return any(image.landmarks for image in self.images)


def annotate_images(
    calibration: Calibration,
    files: Sequence[ImageFile],
    older: Calibration | None = None,
    localizer: "LearnedLocalizer | None" = None,
    boards: Mapping[str, BoardSeen] | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> AnnotatedImages:
    """Draw a calibration into some of its images.

    The older calibration is drawn pale and dashed; the localizer detects landmarks. Corners of
    boards are drawn by name of the image.
    """
    camera = calibration.camera
    if camera is None:
        return AnnotatedImages(missing=("No pictures: the calibration holds no intrinsics.",))
    axes = axes_in_view(camera, calibration.parent_from_child.inverse())
    older_axes = None
    if older is not None:
        older_axes = axes_in_view(camera, older.parent_from_child.inverse())
    annotated, missing, detail = [], [], None
    for file in files:
        try:
            image = read_image(file.path)
        except InputError as error:
            missing.append(f"One picture is missing: {error}.")
            continue
        height, width = image.shape[:2]
        if abs(camera.width * height / (camera.height * width) - 1) > _ASPECT_TOLERANCE:
            missing.append(
                f"One picture is missing: {file.path} is {width}x{height}, which does not fit the"
                f" camera, {camera.width}x{camera.height}."
            )
            continue
        if not annotated:
            detail = close_up(image, camera, axes, older_axes, _CLOSE_UP_PX)
        use = file.use
        board = boards.get(use.name) if boards and use is not None else None
        drawer = board if board is not None else localizer
        annotated.append(_annotate(calibration, file, image, (axes, older_axes), drawer))
        on_image()
    if annotated and localizer is None and not boards:
        missing.append("No landmarks: pass --store to draw them.")
    other_map = localizer is not None and _is_other_map(calibration, localizer)
    return AnnotatedImages(
        tuple(annotated),
        axes,
        older_axes,
        detail,
        tuple(missing),
        other_map,
        Surroundings() if localizer is None else _surroundings(calibration, localizer),
    )


def _surroundings(calibration: Calibration, localizer: "LearnedLocalizer") -> Surroundings:
    """Return the map that a fixed camera was calibrated in; empty for other cameras and maps."""
    from evercal.mapping.scene_map import SceneMap

    name = calibration.source.get("scene")
    scene = next((s for s in localizer.contents.scenes if s.name == name), None)
    if calibration.mount != "eye_to_hand" or not isinstance(scene, SceneMap):
        return Surroundings()
    return Surroundings.of(scene) if scene.unit_known else Surroundings()


def select_images(
    calibration: Calibration, folder: Path, given: Sequence[Path] = ()
) -> tuple[list[ImageFile], str]:
    """Choose the images to draw into.

    Relative names are also searched in `folder`; `given` files replace the images of the
    calibration. Returns at most `MAX_IMAGES` files, spread over all, including a rejected one if
    there is any. Without files, the sentence has the reason.
    """
    if given:
        uses = {Path(use.name).resolve(): use for use in calibration.images}
        return _spread([ImageFile(path, uses.get(path.resolve())) for path in given]), ""
    if not calibration.images:
        return [], "No pictures: the calibration names no images; pass some with --images."
    used: list[ImageFile] = []
    rejected: list[ImageFile] = []
    for use in calibration.images:
        path = next((p for p in (Path(use.name), folder / use.name) if p.is_file()), None)
        if path is not None:
            (used if use.used else rejected).append(ImageFile(path, use))
    if not used and not rejected:
        return [], (
            f"No pictures: none of the {len(calibration.images)} images of the calibration exists"
            f" (first: {calibration.images[0].name}); pass images with --images."
        )
    if not used:
        return _spread(rejected), ""
    return [*_spread(used, MAX_IMAGES - len(rejected[:1])), *rejected[:1]], ""


def _spread(files: list[ImageFile], count: int = MAX_IMAGES) -> list[ImageFile]:
    chosen = np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)
    return [files[i] for i in np.unique(chosen)]


def _annotate(
    calibration: Calibration,
    file: ImageFile,
    image: Image,
    axes: tuple[AxesInView, AxesInView | None],
    evidence: "LearnedLocalizer | BoardSeen | None",
) -> AnnotatedImage:
    """Resize an image to the page width and draw corners or landmarks, and axes."""
    import cv2

    assert calibration.camera is not None, "annotate_images requires intrinsics"
    height = max(1, round(image.shape[0] * _WIDTH_PX / image.shape[1]))
    method = cv2.INTER_AREA if image.shape[1] > _WIDTH_PX else cv2.INTER_CUBIC
    large = cv2.resize(image, (_WIDTH_PX, height), interpolation=method).astype(np.uint8)
    summary, count = _use(file.use), None
    if isinstance(evidence, BoardSeen):
        large, detection = _with_corners(calibration.camera, large, evidence)
        summary = f"{summary}; {detection}"
    elif evidence is not None:
        large, detection, count = _with_landmarks(calibration, image, large, evidence)
        summary = f"{summary}; {detection}"
    scale, frame = _WIDTH_PX / calibration.camera.width, calibration.parent_frame
    now, before = axes
    drawn = draw_axes(large, now.scaled(scale), frame)
    if before is not None:
        drawn = draw_axes(drawn, before.scaled(scale), older=True)
    if now.outside:
        drawn = draw_directions(drawn, now, frame)
    return AnnotatedImage(str(file.path), drawn, summary, count)


def _with_landmarks(
    calibration: Calibration, image: Image, large: Image, localizer: "LearnedLocalizer"
) -> tuple[Image, str, int]:
    """The enlarged image with landmarks, a summary of them and their number."""
    estimate = localizer.localize(image, calibration.camera)
    scene = calibration.source.get("scene")
    if scene is not None and estimate.scene not in (None, scene):
        return large, f"shows {estimate.scene}, not {scene}", 0
    # A camera on the gripper moves, so its images are compared with their own poses.
    pose = calibration.parent_from_child if calibration.mount == "eye_to_hand" else None
    errors = landmark_errors(estimate, localizer, calibration.camera, pose)
    if errors is None:
        return large, estimate.reason or estimate.status.replace("_", " "), 0
    own = image.shape[0] / errors.height
    residuals = own * errors.errors_px
    drawn, times = draw_residuals(large, errors, own)
    median = float(np.nanmedian(residuals)) if np.isfinite(residuals).any() else np.nan
    summary = (
        f"{len(residuals)} landmarks, median residual {median:.2f} px, lines {times} times as long"
    )
    return drawn, summary, len(residuals)


def _with_corners(camera: Camera, large: Image, board: BoardSeen) -> tuple[Image, str]:
    """The enlarged image with corners and residual vectors, and a summary."""
    enlarged = large.shape[1] / camera.width
    errors = board.projected(camera) - board.view.pixels
    pixels = resize_pixels(board.view.pixels, enlarged)
    lengths = np.linalg.norm(errors, axis=1)
    limits = (0.0, max(1.0, float(np.nanpercentile(lengths, 90))))
    drawn = overlay_points(large, pixels, lengths, 2.5, limits, "residual (px)")
    drawn, times = overlay_vectors(drawn, pixels, enlarged * errors)
    rms = float(np.sqrt(np.nanmean(lengths**2)))
    return drawn, f"{len(pixels)} corners, {rms:.2f} px rms, lines {times} times as long"


def _use(use: ImageUse | None) -> str:
    if use is None:
        return "not an image of the calibration"
    return "used" if use.used else f"rejected: {use.reason}"


def _is_other_map(calibration: Calibration, localizer: "LearnedLocalizer") -> bool:
    """Whether the map differs from that of the calibration, as far as the source states it."""
    scene, digest = calibration.source.get("scene"), calibration.source.get("map")
    if digest is None or scene not in localizer.scenes:
        return digest is not None
    from evercal.localization.localizer import Localizer

    return (
        not isinstance(localizer, Localizer)
        or localizer.contents.scene(str(scene)).digest != digest
    )
