"""Images of a calibrated camera with the axes of the parent frame and the landmarks drawn in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from evercal.calibration.boards.board_poses import read_board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Calibration, ImageUse
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms, resize_pixels
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
from evercal.reports.page import Table
from evercal.reports.scene import Surroundings
from evercal.typing import Array, Image, Strings

if TYPE_CHECKING:
    from evercal.reports.inspected import LearnedLocalizer


MAX_IMAGES = 4


@frozen_arrays
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


@frozen_arrays
class AnnotatedImages:
    """The images of a calibration with overlays."""

    images: Mapping[str, LandmarkPicture] = field(default_factory=dict)
    """At most `MAX_IMAGES`, by path; each summary begins with the use in the calibration."""
    missing: Strings = ()
    """Sentences about overlays that are not possible."""
    other_map: bool = False
    """Whether the map in the store differs from the map of the calibration."""
    surroundings: Surroundings = field(default_factory=Surroundings)
    """The map that a fixed camera was calibrated in; empty without a store."""
    links: Table | None = None
    """How the images show each link, where the outline of an arm is drawn."""


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
        files = [ImageFile(path, uses.get(path.resolve())) for path in given]
        return _spread(files), ""
    if not calibration.images:
        words = "No pictures: the calibration names no images; pass some with `images`."
        return [], words
    used: list[ImageFile] = []
    rejected: list[ImageFile] = []
    for use in calibration.images:
        path = _existing([Path(use.name), folder / use.name])
        if path is None:
            continue
        if use.used:
            used.append(ImageFile(path, use))
        else:
            rejected.append(ImageFile(path, use))
    if not used and not rejected:
        return [], (
            f"No pictures: none of the {len(calibration.images)} images of the calibration exists"
            f" (first: {calibration.images[0].name}); pass images with `images`."
        )
    if not used:
        return _spread(rejected), ""
    return [*_spread(used, MAX_IMAGES - len(rejected[:1])), *rejected[:1]], ""


def _existing(paths: Sequence[Path]) -> Path | None:
    for path in paths:
        if path.is_file():
            return path
    return None


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
        evidence: LearnedLocalizer | BoardSeen | None = localizer
        if boards and file.use is not None:
            evidence = boards.get(file.use.name) or localizer
        drawn = _with_evidence(calibration, camera, image, evidence)
        picture = drawn.image
        if older is not None:
            pose = older.parent_from_child.inverse()
            picture = draw_axes(picture, camera, pose, pale=True)
        pose = calibration.parent_from_child.inverse()
        picture = draw_axes(picture, camera, pose)
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
    around = Surroundings()
    still = not calibration.on_gripper
    if still and scene is not None and scene.metric and scene.parent_frame == "base":
        around = Surroundings.of(scene)
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
    pose = None
    if not calibration.on_gripper and estimate.parent_frame == "base":
        pose = calibration.parent_from_child
    return draw_landmarks(
        image,
        estimate,
        evidence,
        camera,
        pose,
    )


def _with_corners(camera: Camera, large: Image, board: BoardSeen) -> LandmarkPicture:
    enlarged = large.shape[1] / camera.width
    detected = board.view.pixels
    errors = board.projected(camera) - detected
    pixels = resize_pixels(detected, enlarged)
    lengths = norms(errors)
    typical = float(np.nanpercentile(lengths, 90))
    largest = max(1.0, typical)
    vectors = enlarged * errors
    drawn, times = draw_residuals(
        large,
        pixels,
        vectors,
        lengths,
        largest,
    )
    mean_square = np.nanmean(lengths**2)
    rms = float(np.sqrt(mean_square))
    summary = f"{len(pixels)} corners, {rms:.2f} px rms, lines {times} times as long"
    return LandmarkPicture(drawn, 0, summary)


def _use(use: ImageUse | None) -> str:
    if use is None:
        return "not an image of the calibration"
    if use.used:
        return "used"
    return f"rejected: {use.reason}"


def _scene_of(
    calibration: Calibration, localizer: "LearnedLocalizer"
) -> SceneMap | None:
    name = calibration.source.get("scene")
    digest = calibration.source.get("map")
    maps = [scene for scene in localizer.contents.scenes if isinstance(scene, SceneMap)]
    for scene in maps:
        if scene.digest == digest:  # also after a rename
            return scene
    for scene in maps:
        if scene.name == name:
            return scene
    return None


def boards_seen(calibration: Calibration, folder: Path) -> dict[str, BoardSeen]:
    """The board in each image of a calibration by `evercal solve`, whose file lies in `folder`."""
    poses = calibration.checks.camera_from_board
    given = Path(str(calibration.source.get("camera_poses", "")))
    file = _existing([folder / given, given, folder / given.name])
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
