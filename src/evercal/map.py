"""`Map`: learned scenes, with methods to localize, track and calibrate.

Learning a scene reads through four files: `Map.learn` in `learning.learned_scenes`,
`learning.scene`, `mapping.build.build_map`, and `mapping.store.MapStore.commit`. Methods import
what they need, so that a robot that only locates images loads no module that calibrates.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from evercal.classes import html_table
from evercal.errors import InputError
from evercal.learning.learned_scenes import LearnedScenes
from evercal.mapping.store import MapStore
from evercal.recordings.frame import Recording
from evercal.recordings.images import NamedPictures, read_image
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.robot.mount import MountName
from evercal.typing import PathLike

if TYPE_CHECKING:
    import numpy as np

    from evercal.calibration.calibration import Calibration
    from evercal.calibration.drift import Shift
    from evercal.calibration.from_map.align import MapAlignment
    from evercal.calibration.image_source import ImageSource
    from evercal.evaluation import Scores
    from evercal.features.encoder import Features
    from evercal.geometry import SE3, Camera, UncertainPose
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.options import LocalizeOptions
    from evercal.localization.tracking import TrackedFrame, TrackOptions


class Map(LearnedScenes):
    """A map on disk: scenes are added by `learn`, images are located by `localize`.

    Open one with `Map.open`.

    Args:
        store: the map's files.
        options: effort and thresholds of localization.
    """

    def __init__(self, store: MapStore, options: LocalizeOptions | None = None):
        super().__init__(store, options)

    def __repr__(self) -> str:
        count = len(self.scenes)
        return f"Map({str(self.path)!r}, {count} scenes: {', '.join(self.scenes)})"

    def _repr_html_(self) -> str:
        rows = {}
        for scene in self._store.contents.scenes:
            keyframes = len(scene.keyframes)
            rows[scene.name] = f"{keyframes} keyframes, {scene.landmarks} landmarks"
        return html_table(f"Map {self.path}", rows)

    @classmethod
    def open(
        cls,
        path: PathLike,
        *,
        encoder: Path | Features | None = None,
        options: LocalizeOptions | None = None,
    ) -> Self:
        """Open a map, or prepare a new one that the first `learn` writes.

        Args:
            path: folder of the map.
            encoder: for a new map, an ONNX file; or a function of the caller's own on arrays (see
                `features.encoder.Features`), which then must be given every time. Default: the
                shipped encoder.
            options: effort and thresholds of localization.

        Raises:
            InputError: The folder holds something else, or a file is missing or was changed.
        """
        return cls(MapStore.open_or_create(Path(path), encoder), options)

    @classmethod
    def unpack(cls, file: PathLike, path: PathLike, **how: Any) -> Self:
        """Extract a map that `pack` has written, and open it.

        The file is not trusted, see `mapping.manage.unpack_map`.

        Args:
            file: the archive.
            path: folder of the map; it must be new.
            how: as `open`.

        Raises:
            InputError: The folder holds something, or the archive is no complete map.
        """
        from evercal.mapping.manage import unpack_map

        unpack_map(Path(file), Path(path))
        return cls.open(path, **how)

    def localize(
        self, image: np.ndarray | PathLike, camera: Camera | None = None
    ) -> PoseEstimate:
        """Estimate the camera pose of one image or image file, see `Localizer.localize`."""
        if isinstance(image, str | os.PathLike):
            image = read_image(image)
        return self.localizer.localize(image, camera)

    def track(
        self,
        frames: Iterable[np.ndarray | tuple[float, np.ndarray]],
        *,
        camera: Camera | None = None,
        options: TrackOptions | None = None,
    ) -> Iterator[TrackedFrame]:
        """Locate the frames of one camera in order; the last pose is the prior of the next one.

        Args:
            frames: Images (H, W, 3), or pairs of time in seconds and image.
            camera: Intrinsics. Default: those of the camera that recorded the scene.
            options: Effort, time for a frame, smoothing.

        Yields:
            State (`tracking`, `relocalized` or `lost`) and answer of each frame.

        Raises:
            InputError: As `localize`.
        """
        from evercal.localization.tracking import Tracker, TrackOptions

        return Tracker(self.localizer, camera, options or TrackOptions()).frames(frames)

    def calibrate(
        self,
        images: ImageSource,
        *,
        robot_poses: PathLike | SE3 | None = None,
        camera: Camera | None = None,
        mount: MountName | None = None,
        frames: FrameNames = UNKNOWN,
        on_image: Callable[[], object] = lambda: None,
    ) -> Calibration:
        """Calibrate a camera from its images; no marker is needed.

        Args:
            images: a folder, image files or arrays (H, W, 3), all from one camera.
            robot_poses: base_from_gripper of every image, as a file or (n,) poses, for a camera on
                the gripper, and where the scene is a thing in the gripper.
            camera: Intrinsics. Default: those of the camera that recorded the scene.
            mount: `eye_to_hand` or `eye_in_hand`. Default: decided from the camera's motion.
            frames: names of the camera's frame, and of those of `robot_poses`.
            on_image: called after each image.

        Returns:
            base_from_camera for eye_to_hand, gripper_from_camera for eye_in_hand.

        Raises:
            InputError: No image was located, or unusable images or poses.
        """
        arguments = locals()
        from evercal.calibration.from_images import calibrate
        from evercal.calibration.image_source import Images
        from evercal.storage.provenance import call

        with call(("Map.calibrate",), {**arguments, "map": self.path}):
            given = Images.of(images, camera, robot_poses, frames=frames)
            return calibrate(self.localizer, given, mount, on_image=on_image)

    def calibration(self, scene: str | None = None) -> Calibration:
        """The `gripper_from_camera` that learning a wrist recording has estimated.

        Args:
            scene: Name of the scene. Default: the only one that was learned from gripper poses.

        Raises:
            InputError: No such scene, or none or several that were learned from gripper poses.
        """
        from evercal.calibration.learned import learned_calibration

        return learned_calibration(self.path, scene)

    def align(
        self,
        scene: str,
        images: ImageSource = (),
        *,
        robot_poses: PathLike | SE3 | None = None,
        convention: str | None = None,
        boards: Mapping[str, SE3] | None = None,
        points: Mapping[str, np.ndarray] | None = None,
        picks: Sequence[tuple[str, np.ndarray, Mapping[str, np.ndarray]]] = (),
        distances: Mapping[tuple[str, str], float] | None = None,
        board_poses: PathLike | None = None,
        board_at: UncertainPose | None = None,
        unknown_scale: bool = False,
        base_frame: str | None = None,
    ) -> MapAlignment:
        """Transform a scene in a frame of its own to the base frame, from images or points.

        Args:
            scene: Name of the scene; its previous alignment is ignored.
            images: Of a camera on the gripper, from five or more places that turn about two axes.
            robot_poses: base_from_gripper of every image, as a file or (n,) poses.
            convention: Format of the file, if it does not state it.
            boards: camera_from_board by image name, for a fixed camera and a board in the gripper.
            points: Instead of images: (3,) touched points by name in the base frame, metres.
            picks: Name, image (H, W, 3) and pixels (2,) by name of the point, of each image.
            distances: Instead of points: metres between picked points; the frame stays its own.
            board_poses: File of `evercal detect` for images of a board that stands still.
            board_at: base_from_board of it; by default, the board is the base.
            unknown_scale: Estimate the scale also where the recording was in metres.
            base_frame: Name of the base frame.

        Raises:
            InputError: No such scene, too few images or points, or another process writes a map.
        """
        from evercal.calibration.from_map.align import align_by_gripper
        from evercal.calibration.from_map.by_board import align_by_board
        from evercal.calibration.from_map.by_points import align_by_points
        from evercal.calibration.from_map.known_distance import by_distances
        from evercal.learning.mapped_already import placed

        with self._store.writing():
            own = self.localizer.contents.scene(scene)
            scale_known = own.unit is None and not unknown_scale
            where = self.localizer, scene
            if distances:
                found = by_distances(*where, distances, picks)
            elif board_poses is not None:
                found = align_by_board(*where, board_poses, board_at, scale_known)
            elif points is not None:
                found = align_by_points(*where, points, picks, scale_known)
            else:
                given = _with_grippers(images, robot_poses, convention)
                found = align_by_gripper(*where, *given, scale_known, boards)
            frames = replace(own.frames, base=base_frame or "")
            aligned = replace(found.applied_to(own), frames=frames, places={})
            others = self._store.contents.without(scene)
            self._store.update(placed(aligned, others)[0])
        self._changed()
        return found

    def check(
        self,
        images: ImageSource,
        calibration: Calibration,
        *,
        robot_poses: PathLike | SE3 | None = None,
        camera: Camera | None = None,
        on_image: Callable[[], object] = lambda: None,
    ) -> Shift:
        """Test whether a fixed camera has moved since it was calibrated.

        Args:
            images: of the camera as it stands now.
            calibration: its calibration.
            robot_poses: base_from_gripper of every image, as a file or (n,) poses, where the scene
                is a thing in the gripper.
            camera: Intrinsics. Default: those of the calibration.
            on_image: called after each image.

        Raises:
            InputError: No image was located, or the calibration is of a camera on the gripper.
        """
        from evercal.calibration.drift import check
        from evercal.calibration.image_source import Images

        given = Images.of(images, camera, robot_poses)
        poses = given.base_from_gripper
        return check(
            self.localizer, given.images, calibration, given.camera, on_image, poses
        )

    def evaluate(
        self,
        recordings: PathLike
        | Recording
        | Sequence[Recording]
        | Mapping[str, Recording],
    ) -> Scores:
        """Score the map on the test frames of recordings.

        Args:
            recordings: recordings or the path of one; a mapping gives the scenes' names.

        Raises:
            InputError: A recording that the map has not learned, or without test frames.
        """
        from evercal.evaluation import evaluate, scores

        return scores(evaluate(self.localizer, recordings))


def _with_grippers(
    images: ImageSource, robot_poses: PathLike | SE3 | None, convention: str | None
) -> tuple[NamedPictures, SE3]:
    from evercal.calibration.image_source import Images

    given = Images.of(images, None, robot_poses, convention)
    if given.base_from_gripper is None:
        raise InputError(
            "give images with robot_poses, points with picks, or board_poses"
        )
    return given.images, given.base_from_gripper
