"""`Map`: learned scenes, with methods to localize, track and calibrate.

Learning a scene reads through four files: `Map.learn` here, `learning.scene`,
`mapping.build.build_map`, and `mapping.store.MapStore.commit`. Methods import what they need, so
that a robot that only locates images loads no module that learns or calibrates.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from evercal.errors import InputError
from evercal.mapping.store import MapStore
from evercal.recordings.frame import Recording
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount, MountName
from evercal.typing import PathLike

if TYPE_CHECKING:
    import numpy as np

    from evercal.calibration.calibration import Calibration
    from evercal.calibration.drift import Shift
    from evercal.calibration.from_images import ImageSource
    from evercal.calibration.from_map.align import MapAlignment
    from evercal.evaluation import Scores
    from evercal.features.encoder import Features
    from evercal.geometry import SE3, Camera
    from evercal.learning.scene import LearnReport
    from evercal.learning.task import Learned
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer
    from evercal.localization.options import LocalizeOptions
    from evercal.localization.refreshing import RefreshReport
    from evercal.localization.tracking import TrackedFrame, TrackOptions
    from evercal.mapping.build import MapOptions
    from evercal.mapping.manage import Merged, OnClash
    from evercal.mapping.refresh import RefreshOptions
    from evercal.progress import OnProgress


class Map:
    """A map on disk: scenes are added by `learn`, images are located by `localize`.

    Open one with `Map.open`.

    Args:
        store: the map's files.
        options: effort and thresholds of localization.
    """

    def __init__(self, store: MapStore, options: LocalizeOptions | None = None):
        self._store = store
        self._options = options
        self._localizer: Localizer | None = None

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

    @property
    def path(self) -> Path:
        """Folder of the map."""
        return self._store.root

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order of learning."""
        return tuple(scene.name for scene in self._store.contents.scenes)

    @property
    def localizer(self) -> Localizer:
        """The localizer of all scenes.

        Raises:
            InputError: No scene has been learned.
        """
        from evercal.localization.localizer import Localizer

        if self._localizer is None:
            if not self.scenes:
                raise InputError(
                    f"map {self.path}: no scene learned yet; run 'evercal learn'"
                )
            self._localizer = Localizer(self._store.contents, self._options)
        return self._localizer

    def learn(
        self,
        recording: PathLike | Recording,
        *,
        name: str | None = None,
        memory: str | int | None = None,
        gripper_from_camera: SE3 | None = None,
        options: MapOptions | None = None,
        on_progress: OnProgress | None = None,
    ) -> LearnReport:
        """Learn a scene; the scenes learned before do not change.

        A recording that states gripper poses and no camera poses also yields `gripper_from_camera`,
        see `LearnReport.hand_eye` and `calibration`.

        Args:
            recording: a recording or its path. Training frames are learned; test frames are not
                read.
            name: of the scene. Default: the recording's name.
            memory: keyframes to keep: a share of the frames ("10%"), a size ("5MB"), or "auto" for
                the fewest that locate the recording's other frames well. Default: 10 %, at least
                eight.
            gripper_from_camera: a rough one, such as from CAD, that the estimate is compared with.
            options: sizes and priors of the map; `memory` overrides theirs.
            on_progress: called with the current step, how much of it is done, and its total.
                Default: bars on stderr.

        Raises:
            InputError: A recording that cannot be used, a name that is taken, or another process
                is writing into the map.
        """
        return self._learn(
            recording, name, memory, gripper_from_camera, options, on_progress
        )

    def eye_to_hand(
        self,
        recording: PathLike | Recording,
        *,
        name: str | None = None,
        on_progress: OnProgress | None = None,
    ) -> Calibration:
        """Calibrate a fixed camera by any textured thing in the gripper; no marker is needed.

        The thing becomes a scene of the map, in the frame of the gripper. `calibrate` and `check`
        with `robot_poses` use it again: for this camera, and for others that see the thing.

        Args:
            recording: Images of the fixed camera and `base_from_gripper` at each, or their path.
                The gripper turns the thing by 20 degrees and more about two axes.
            name: Of the scene. Default: the recording's name.
            on_progress: Called with the current step, how much of it is done, and its total.
                Default: bars on stderr.

        Returns:
            base_from_camera with its covariance.

        Raises:
            InputError: A recording that cannot be used, with the cause; a name that is taken; or
                another process is writing into the map.
        """
        report = self._learn(
            recording, name, None, None, None, on_progress, EYE_TO_HAND
        )
        return self.calibration(report.scene)

    def _learn(
        self,
        recording: PathLike | Recording,
        name: str | None,
        memory: str | int | None,
        gripper_from_camera: SE3 | None,
        options: MapOptions | None,
        on_progress: OnProgress | None,
        mount: Mount | None = None,
    ) -> LearnReport:
        from evercal.learning.scene import learn_scene
        from evercal.progress import shown
        from evercal.recordings import load_recording
        from evercal.recordings.held_out import named_recording

        loaded = (
            recording if isinstance(recording, Recording) else load_recording(recording)
        )
        loaded = named_recording(loaded, name, self.scenes)
        with self._store.writing(), shown(on_progress) as step:
            contents = self._store.contents
            scene, report = learn_scene(
                loaded,
                contents,
                memory,
                gripper_from_camera,
                options,
                step,
                mount or EYE_IN_HAND,
            )
            self._store.commit(scene, asdict(report))
        self._localizer = None
        return report

    def learn_many(
        self,
        recordings: Iterable[PathLike | Recording],
        *,
        read: Callable[[Path], Recording] | None = None,
        workers: int = 2,
        ray: str | None = None,
        results: PathLike | None = None,
        memory: str | int | None = None,
        options: MapOptions | None = None,
        on_scene: Callable[[LearnReport], object] = lambda _: None,
        on_progress: OnProgress | None = None,
    ) -> tuple[LearnReport, ...]:
        """Learn recordings in parallel; the result is identical to learning them one by one.

        Scenes are added in the order of the recordings. A recording that cannot be used does not
        stop the others.

        Args:
            recordings: Recordings, their paths, or addresses such as `s3://bucket/folder`, which
                the workers copy.
            read: Reads the recording at a path. Default: `load_recording`.
            workers: Processes; they share the threads of this machine.
            ray: Address of a Ray cluster, whose workers learn instead: `auto`, `HOST:PORT` or
                `ray://HOST:PORT`. All its machines reach the paths.
            results: Folder or address where every learned scene is kept, so that the same call
                goes on where another one was stopped.
            memory: Keyframes of each scene, as for `learn`.
            options: Sizes and priors of the map.
            on_scene: Called after each scene was added.
            on_progress: Called with the step, the recordings done, and their number.
                Default: bars on stderr.

        Raises:
            InputError: A name that is taken, before anything is learned; or, after the others were
                learned, recordings that cannot be used.
        """
        from evercal.learning.many import learn_scenes
        from evercal.learning.task import LearnTask, Source
        from evercal.mapping.memory_budget import MemoryBudget
        from evercal.progress import shown
        from evercal.recordings import load_recording
        from evercal.recordings.addresses import RecordingAt, is_address
        from evercal.recordings.held_out import named_recording

        MemoryBudget.parse(memory)
        read = read or load_recording
        loaded = list[Source]()
        failed: list[str] = []
        taken = {*self.scenes}
        # Workers of a cluster begin in another folder, and results are kept by path.
        place = os.fspath if ray is results is None else os.path.abspath
        for item in recordings:
            try:
                if isinstance(item, Recording):
                    source = item
                elif is_address(item):
                    source = RecordingAt.of(str(item))
                else:
                    source = read(Path(place(item)))
            except InputError as error:
                failed.append(str(error))
                continue
            loaded.append(named_recording(source, None, taken))
            taken.add(loaded[-1].name)
        reports: list[LearnReport] = []
        given = len(loaded) + len(failed)
        with self._store.writing(), shown(on_progress) as step:
            where = os.fspath if is_address(results) else os.path.abspath
            kept = None if results is None else where(results)
            task = LearnTask(self._store.contents.empty(), memory, options, read, kept)
            ready: dict[int, Learned] = {}
            following = 0
            step("learning", 0, len(loaded))
            for done, outcome in enumerate(learn_scenes(task, loaded, workers, ray), 1):
                step("learning", done, len(loaded))
                ready[outcome.number] = outcome
                while (learned := ready.pop(following, None)) is not None:
                    following += 1
                    if learned.scene is None or learned.report is None:
                        failed.append(
                            f"{loaded[learned.number].name} ({learned.error})"
                        )
                        continue
                    size = self._store.contents.with_scene(learned.scene).memory_bytes
                    report = replace(learned.report, memory_bytes=size)
                    self._store.commit(learned.scene, asdict(report))
                    self._localizer = None
                    reports.append(report)
                    on_scene(report)
        if failed:
            raise InputError(
                f"{len(failed)} of {given} recordings were not learned: {'; '.join(failed)}"
            )
        return tuple(reports)

    def refresh(
        self,
        images: ImageSource | Recording,
        *,
        camera: Camera | None = None,
        options: RefreshOptions | None = None,
        on_progress: OnProgress | None = None,
    ) -> RefreshReport:
        """Follow a changed room: new images of a scene replace what is gone, in the same memory.

        Images need no poses: they are located in the map. Images that cannot be located precisely
        are left out. Keyframes that stay keep the base frame.

        Args:
            images: A folder, image files or arrays (H, W, 3) of one camera, or a recording, whose
                training frames are used.
            camera: Intrinsics. Default: those of the recording, or of the camera that recorded
                the scene.
            options: Thresholds.
            on_progress: Called with the current step, how much of it is done, and its total.
                Default: bars on stderr.

        Raises:
            InputError: Too few images are located, the refreshed map would locate fewer of them, or
                another process writes into the map. The map is unchanged.
        """
        from evercal.calibration.from_images import Images
        from evercal.localization.refreshing import refresh_scene
        from evercal.progress import shown

        if isinstance(images, Recording):
            given = [(frame.name, frame.image) for frame in images.train]
            cameras = [camera or frame.camera for frame in images.train]
        else:
            given = Images.of(images).images
            cameras = [camera] * len(given)
        with self._store.writing(), shown(on_progress) as step:
            scene, report = refresh_scene(self.localizer, given, cameras, options, step)
            self._store.refresh(scene, asdict(report))
        self._localizer = None
        return report

    def undo_refresh(self, scene: str) -> None:
        """Bring back the state of a scene before its last refresh.

        Raises:
            InputError: No such scene, nothing to undo, or another process writes into the map.
        """
        self._store.undo(scene)
        self._localizer = None

    def remove(self, *names: str) -> None:
        """Remove scenes, all in one step; the other scenes do not change.

        Raises:
            InputError: No such scene, or another process writes into the map.
        """
        from evercal.mapping.manage import remove_scenes

        remove_scenes(self._store, names)
        self._localizer = None

    def rename(self, name: str, new: str) -> None:
        """Give a scene another name.

        Raises:
            InputError: No such scene, a name that is taken or unusable, or another process writes
                into the map.
        """
        from evercal.mapping.manage import rename_scene

        rename_scene(self._store, name, new)
        self._localizer = None

    def merge(self, *others: PathLike, on_clash: OnClash = "refuse") -> Merged:
        """Add the scenes of other maps, all in one step; see `mapping.manage.merge_maps`.

        Raises:
            InputError: Not a map, another encoder or image size, a name that is taken, or another
                process writes into the map.
        """
        from evercal.mapping.manage import merge_maps

        merged = merge_maps(self._store, others, on_clash)
        self._localizer = None
        return merged

    def pack(self, file: PathLike) -> None:
        """Write the map into one file, a zip archive; an existing file is replaced.

        Raises:
            InputError: No scene has been learned, or a file of the map is missing or was changed.
        """
        from evercal.mapping.manage import pack_map

        pack_map(self.path, Path(file))

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

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        """Estimate the camera pose of one image, see `Localizer.localize`."""
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
        on_image: Callable[[], object] = lambda: None,
    ) -> Calibration:
        """Calibrate a camera from its images; no marker is needed.

        Args:
            images: a folder, image files or arrays (H, W, 3), all from one camera.
            robot_poses: base_from_gripper of every image, as a file or (n,) poses, for a camera on
                the gripper, and where the scene is a thing in the gripper.
            camera: Intrinsics. Default: those of the camera that recorded the scene.
            mount: `eye_to_hand` or `eye_in_hand`. Default: decided from the camera's motion.
            on_image: called after each image.

        Returns:
            base_from_camera for eye_to_hand, gripper_from_camera for eye_in_hand.

        Raises:
            InputError: No image was located, or unusable images or poses.
        """
        from evercal.calibration.from_images import Images, calibrate

        given = Images.of(images, camera, robot_poses)
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
        unknown_scale: bool = False,
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
            unknown_scale: Estimate the scale also where the recording was in metres.

        Raises:
            InputError: No such scene, too few images or points, or another process writes into the
                map. The map is unchanged.
        """
        from evercal.calibration.from_images import Images
        from evercal.calibration.from_map.align import align_by_gripper, align_by_points

        with self._store.writing():
            own = self.localizer.contents.scene(scene)
            scale_known = own.unit is None and not unknown_scale
            if points is not None:
                found = align_by_points(
                    self.localizer, scene, points, picks, scale_known
                )
            else:
                given = Images.of(images, None, robot_poses, convention)
                if (poses := given.base_from_gripper) is None:
                    raise InputError(
                        "give images with robot_poses, or points with picks"
                    )
                found = align_by_gripper(
                    self.localizer, scene, given.images, poses, scale_known, boards
                )
            self._store.update(found.applied_to(own))
        self._localizer = None
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
        from evercal.calibration.from_images import Images

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
