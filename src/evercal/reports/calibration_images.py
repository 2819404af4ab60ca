"""Images of a calibrated camera with the axes of the parent frame and the landmarks drawn in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from evercal.calibration.boards.board_poses import read_board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration, ImageUse
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, resize_pixels
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.images import read_image
from evercal.reports.overlay import (
    PICTURE_PX,
    LandmarkPicture,
    draw_axes,
    draw_landmarks,
    draw_residuals,
    resized,
)
from evercal.reports.scene import Surroundings
from evercal.typing import Array, Image

if TYPE_CHECKING:
    from evercal.reports.inspected import LearnedLocalizer


MAX_IMAGES = 4


@dataclass(frozen=True, eq=False)
class BoardSeen:
    """A board in one image."""

    view: BoardView
    """Detected corners."""
    camera_from_board: SE3
    """Pose by the robot's pose and the calibration."""
    scale: float
    """Estimated length per stated length of the board."""

    def projected(self, camera: Camera) -> Array:
        """Return the (k, 2) pixels of the corners by the calibration."""
        return camera.project(
            self.camera_from_board.apply(self.scale * self.view.points_m)
        )


class ImageFile(NamedTuple):
    """An existing image of the camera."""

    path: Path
    use: ImageUse | None
    """Its entry in the calibration; None for other images."""


@dataclass(frozen=True, eq=False)
class AnnotatedImages:
    """The images of a calibration with overlays."""

    images: Mapping[str, LandmarkPicture] = field(default_factory=dict)
    """At most `MAX_IMAGES`, by path; each summary begins with the use in the calibration."""
    missing: tuple[str, ...] = ()
    """Sentences about overlays that are not possible."""
    other_map: bool = False
    """Whether the map in the store differs from the map of the calibration."""
    surroundings: Surroundings = field(default_factory=Surroundings)
    """The map that a fixed camera was calibrated in; empty without a store."""


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
        return _spread(
            [ImageFile(path, uses.get(path.resolve())) for path in given]
        ), ""
    if not calibration.images:
        return (
            [],
            "No pictures: the calibration names no images; pass some with `images`.",
        )
    used: list[ImageFile] = []
    rejected: list[ImageFile] = []
    for use in calibration.images:
        path = next(
            (p for p in (Path(use.name), folder / use.name) if p.is_file()), None
        )
        if path is not None:
            (used if use.used else rejected).append(ImageFile(path, use))
    if not used and not rejected:
        return [], (
            f"No pictures: none of the {len(calibration.images)} images of the calibration exists"
            f" (first: {calibration.images[0].name}); pass images with `images`."
        )
    if not used:
        return _spread(rejected), ""
    return [*_spread(used, MAX_IMAGES - len(rejected[:1])), *rejected[:1]], ""


def _spread(files: list[ImageFile], count: int = MAX_IMAGES) -> list[ImageFile]:
    chosen = np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)
    return [files[i] for i in np.unique(chosen)]


def annotate_images(
    calibration: Calibration,
    files: Sequence[ImageFile],
    older: Calibration | None = None,
    localizer: "LearnedLocalizer | None" = None,
    boards: Mapping[str, BoardSeen] | None = None,
    on_image: Callable[[], object] = lambda: None,
) -> AnnotatedImages:
    """Draw a calibration into some of its images.

    The axes by the older calibration are pale; the localizer detects landmarks. Corners of boards
    are drawn by name of the image.
    """
    camera = calibration.camera
    if camera is None:
        return AnnotatedImages(
            missing=("No pictures: the calibration holds no intrinsics.",)
        )
    annotated: dict[str, LandmarkPicture] = {}
    missing = []
    for file in files:
        try:
            image = _fitting(file.path, camera)
        except InputError as error:
            missing.append(f"One picture is missing: {error}.")
            continue
        board = boards.get(file.use.name) if boards and file.use is not None else None
        drawn = _with_evidence(calibration, camera, image, board or localizer)
        picture = drawn.image
        if older is not None:
            picture = draw_axes(
                picture, camera, older.parent_from_child.inverse(), pale=True
            )
        picture = draw_axes(picture, camera, calibration.parent_from_child.inverse())
        summary = "; ".join(filter(None, [_use(file.use), drawn.summary]))
        annotated[str(file.path)] = LandmarkPicture(picture, drawn.landmarks, summary)
        on_image()
    if annotated and localizer is None and not boards:
        missing.append("No landmarks: pass `store` to draw them.")
    if localizer is None:
        return AnnotatedImages(annotated, tuple(missing))
    scene = _scene_of(calibration, localizer)
    digest = calibration.source.get("map")
    other = digest is not None and (scene is None or scene.digest != digest)
    still = scene is not None and scene.metric and scene.parent_frame == "base"
    around = Surroundings.of(scene if still and not calibration.on_gripper else None)
    return AnnotatedImages(annotated, tuple(missing), other, around)


def _fitting(path: Path, camera: Camera) -> Image:
    image = read_image(path)
    height, width = image.shape[:2]
    if not camera.fits(width, height):
        raise InputError(
            f"{path} is {width}x{height}, which does not fit the camera,"
            f" {camera.width}x{camera.height}"
        )
    return image


def _with_evidence(
    calibration: Calibration,
    camera: Camera,
    image: Image,
    evidence: "LearnedLocalizer | BoardSeen | None",
) -> LandmarkPicture:
    large = resized(image, PICTURE_PX)
    if evidence is None:
        return LandmarkPicture(large, 0, "")
    if isinstance(evidence, BoardSeen):
        return _with_corners(camera, large, evidence)
    estimate = evidence.localize(image, camera)
    scene = calibration.source.get("scene")
    if scene is not None and estimate.scene not in (None, scene):
        return LandmarkPicture(large, 0, f"shows {estimate.scene}, not {scene}")
    # A camera or a thing on the gripper moves, so images are compared with their own poses.
    still = not calibration.on_gripper and estimate.parent_frame == "base"
    pose = calibration.parent_from_child if still else None
    return draw_landmarks(image, estimate, evidence, camera, pose)


def _with_corners(camera: Camera, large: Image, board: BoardSeen) -> LandmarkPicture:
    enlarged = large.shape[1] / camera.width
    errors = board.projected(camera) - board.view.pixels
    pixels = resize_pixels(board.view.pixels, enlarged)
    lengths = np.linalg.norm(errors, axis=1)
    largest = max(1.0, float(np.nanpercentile(lengths, 90)))
    drawn, times = draw_residuals(large, pixels, enlarged * errors, lengths, largest)
    rms = float(np.sqrt(np.nanmean(lengths**2)))
    summary = f"{len(pixels)} corners, {rms:.2f} px rms, lines {times} times as long"
    return LandmarkPicture(drawn, 0, summary)


def _use(use: ImageUse | None) -> str:
    if use is None:
        return "not an image of the calibration"
    return "used" if use.used else f"rejected: {use.reason}"


def _scene_of(
    calibration: Calibration, localizer: "LearnedLocalizer"
) -> SceneMap | None:
    name, digest = (calibration.source.get(key) for key in ("scene", "map"))
    maps = [scene for scene in localizer.contents.scenes if isinstance(scene, SceneMap)]
    own = [scene for scene in maps if scene.digest == digest]  # also after a rename
    return next((scene for scene in (*own, *maps) if own or scene.name == name), None)


def boards_seen(calibration: Calibration, folder: Path) -> dict[str, BoardSeen]:
    """The board in each image of a calibration by `evercal solve`, whose file lies in `folder`."""
    poses = calibration.checks.camera_from_board
    given = Path(str(calibration.source.get("camera_poses", "")))
    file = next(
        (f for f in (folder / given, given, folder / given.name) if f.is_file()), None
    )
    if not isinstance(poses, dict) or file is None:
        return {}
    try:
        board = read_board_poses(file)
    except InputError:  # poses by other programs have no corners
        return {}
    views = {(file.parent / image.name).resolve(): image.view for image in board.images}
    scale = float(calibration.checks.scale or 1.0)
    seen = {}
    for name, pose in poses.items():
        view = views.get((folder / name).resolve()) or views.get(
            (file.parent / name).resolve()
        )
        if view is not None:
            camera_from_board = SE3(pose["quaternion_wxyz"], pose["translation_m"])
            seen[name] = BoardSeen(view, camera_from_board, scale)
    return seen
