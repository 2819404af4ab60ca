"""`LearnedScenes`: the scenes of a map on disk, and everything that changes them.

Learning a scene reads through four files: `LearnedScenes.learn` here, `learning.scene`,
`mapping.build.build_map`, and `mapping.store.MapStore.commit`. Methods import what they need, so
that a robot that only locates images loads no module that learns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from evercal.errors import InputError
from evercal.mapping.store import MapStore
from evercal.recordings.frame import Recording
from evercal.typing import PathLike, Strings

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.calibration.image_source import ImageSource
    from evercal.geometry import SE3, Camera
    from evercal.learning.report import LearnReport
    from evercal.localization.localizer import Localizer
    from evercal.localization.options import LocalizeOptions
    from evercal.localization.refreshing import RefreshReport
    from evercal.mapping.build import MapOptions
    from evercal.mapping.manage import Merged, OnClash
    from evercal.mapping.refresh import RefreshOptions
    from evercal.mapping.scene_map import MapContents, SceneMap
    from evercal.progress import OnProgress
    from evercal.robot.pose_errors import ArmErrors

    Learn = Callable[[Recording, OnProgress], tuple[SceneMap, LearnReport]]


class LearnedScenes:
    """Scenes on disk: they are learned, refreshed, renamed, removed, merged and packed.

    Args:
        store: the map's files.
        options: effort and thresholds of localization.
    """

    def __init__(self, store: MapStore, options: LocalizeOptions | None = None):
        self._store = store
        self._options = options
        self._within: Strings = ()
        self._localizer: Localizer | None = None

    def within(self, *scenes: str) -> Self:
        """The same map, whose images are located in some of its scenes only.

        Raises:
            InputError: No such scene.
        """
        restricted = copy(self)
        restricted._within = scenes
        restricted._changed()
        self._store.contents.within(scenes)
        return restricted

    @property
    def path(self) -> Path:
        """Folder of the map."""
        return self._store.root

    @property
    def scenes(self) -> Strings:
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
            if self._within:
                self._localizer = self._localizer.within(self._within)
        return self._localizer

    def learn(
        self,
        recording: PathLike | Recording,
        *,
        name: str | None = None,
        base: str | None = None,
        replace: str | None = None,
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
            base: name of the robot's base. Scenes of one place in one base give one answer.
                Default: that of the recording, or none.
            replace: name of a scene that the new one replaces: the room or the base was moved.
            memory: keyframes to keep: their number (20), a share of the frames ("10%"), a size
                ("5MB"), or "auto" for the fewest that locate the recording's other frames well.
                Default: 10 %, at least eight.
            gripper_from_camera: a rough one, such as from CAD, that the estimate is compared with.
            options: sizes and priors of the map; `memory` overrides theirs.
            on_progress: called with the current step, how much of it is done, and its total.
                Default: bars on stderr.

        Raises:
            InputError: A recording that cannot be used, a name that is taken, poses that are not in
                the base of this name, or another process is writing into the map.
        """
        given = locals()
        from evercal.learning.scene import learn_scene
        from evercal.storage.provenance import call

        def learned(named: Recording, step: OnProgress) -> tuple[SceneMap, LearnReport]:
            contents = self._store.contents
            return learn_scene(
                named, contents, memory, gripper_from_camera, options, step
            )

        with call(("Map.learn",), given):
            return self._add(recording, name, learned, on_progress, (base, replace))

    def eye_to_hand(
        self,
        recording: PathLike | Recording,
        *,
        name: str | None = None,
        replace: str | None = None,
        errors: ArmErrors | None = None,
        on_progress: OnProgress | None = None,
    ) -> Calibration:
        """Calibrate a fixed camera by any textured thing in the gripper; no marker is needed.

        The thing becomes a scene of the map, in the frame of the gripper. `calibrate` and `check`
        with `robot_poses` use it again: for this camera, and for others that see the thing.

        Args:
            recording: Images of the fixed camera and `base_from_gripper` at each, or their path.
                The gripper turns the thing by 20 degrees and more about two axes.
            name: Of the scene. Default: the recording's name.
            replace: Name of a scene that the new one replaces.
            errors: What is known of the arm.
            on_progress: Called with the current step, how much of it is done, and its total.
                Default: bars on stderr.

        Returns:
            base_from_camera with its covariance.

        Raises:
            InputError: A recording that cannot be used, with the cause; a name that is taken; or
                another process is writing into the map.
        """
        given = locals()
        from evercal.calibration.learned import learned_calibration
        from evercal.learning.held_thing import learn_held_thing
        from evercal.storage.provenance import call

        def learned(named: Recording, step: OnProgress) -> tuple[SceneMap, LearnReport]:
            return learn_held_thing(named, self._store.contents, step, errors)

        with call(("Map.eye_to_hand",), given):
            report = self._add(recording, name, learned, on_progress, (None, replace))
        return learned_calibration(self.path, report.scene)

    def _add(
        self,
        recording: PathLike | Recording,
        name: str | None,
        learned: Learn,
        on_progress: OnProgress | None,
        in_map: tuple[str | None, str | None] = (None, None),
    ) -> LearnReport:
        """Read and name a recording, learn it and store its scene.

        `in_map` are the name of its base, and the scene that it replaces.
        """
        from evercal.progress import shown
        from evercal.recordings import load_recording
        from evercal.recordings.held_out import named_recording

        if not isinstance(recording, Recording):
            recording = load_recording(recording)
        base, replaced = in_map
        if replaced is not None:
            self._store.contents.scene(replaced)
        taken = self._store.contents.without(replaced).names
        recording = named_recording(recording, name, taken)
        with self._store.writing(), shown(on_progress) as step:
            scene, report = learned(recording, step)
            return self._commit(scene, report, base or recording.base, replaced)

    def _commit(
        self,
        scene: SceneMap,
        report: LearnReport,
        base: str | None,
        replaced: str | None = None,
    ) -> LearnReport:
        from evercal.learning.mapped_already import placed
        from evercal.storage.provenance import recorded

        kept = self._store.contents.without(replaced)
        scene, same_place = placed(replace(scene, base=base or ""), kept)
        size = kept.with_scene(scene).memory_bytes
        report = replace(report, memory_bytes=size, same_place=same_place)
        self._store.commit(scene, {**report.to_dict(), **recorded()}, replaced)
        self._changed()
        return report

    def learn_many(
        self,
        recordings: Iterable[PathLike | Recording],
        *,
        read: Callable[[Path], Recording] | None = None,
        workers: int = 2,
        ray: str | None = None,
        results: PathLike | None = None,
        base: str | None = None,
        memory: str | int | None = None,
        options: MapOptions | None = None,
        on_scene: Callable[[LearnReport], object] = lambda _: None,
        on_progress: OnProgress | None = None,
    ) -> tuple[LearnReport, ...]:
        """Learn recordings in parallel; the result is identical to learning them one by one.

        Scenes are added in order. A recording that cannot be used does not stop the others.

        Args:
            recordings: Recordings, their paths, or addresses such as `s3://bucket/folder`.
            read: Reads the recording at a path. Default: `load_recording`.
            workers: Processes; they share the threads of this machine.
            ray: Address of a Ray cluster, whose workers learn instead: `auto`, `HOST:PORT` or
                `ray://HOST:PORT`. All its machines reach the paths.
            results: Folder or address that keeps learned scenes for a call that goes on.
            base: Name of the robot's base in all of them, as for `learn`.
            memory: Keyframes of each scene, as for `learn`.
            options: Sizes and priors of the map.
            on_scene: Called after each scene was added.
            on_progress: Called with the step, the recordings done, and their number.

        Raises:
            InputError: A name that is taken, before anything is learned; or, after the others were
                learned, recordings that cannot be used.
        """
        from evercal.learning import many
        from evercal.learning.task import LearnTask
        from evercal.mapping.memory_budget import MemoryBudget
        from evercal.progress import shown
        from evercal.recordings import load_recording

        MemoryBudget.parse(memory)
        read = read or load_recording
        # Workers of a cluster begin in another folder, and results are kept by path.
        absolute = ray is not None or results is not None
        sources, failed = many.named_sources(recordings, read, self.scenes, absolute)
        reports: list[LearnReport] = []
        with self._store.writing(), shown(on_progress) as step:
            contents = self._store.contents.empty()
            kept = many.results_at(results)
            task = LearnTask(contents, memory, options, read, kept)
            outcomes = many.learn_scenes(task, sources, workers, ray)
            for learned in many.in_given_order(outcomes, len(sources), step):
                if learned.scene is None or learned.report is None:
                    failed.append(f"{sources[learned.number].name} ({learned.error})")
                    continue
                reports.append(self._commit(learned.scene, learned.report, base))
                on_scene(reports[-1])
        many.refuse_failures(failed, len(failed) + len(reports))
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
        from evercal.calibration.image_source import Images
        from evercal.localization.refreshing import refresh_scene
        from evercal.progress import shown
        from evercal.storage.provenance import recorded

        if isinstance(images, Recording):
            given = [(frame.name, frame.image) for frame in images.train]
            cameras = [camera or frame.camera for frame in images.train]
            if not given:
                raise InputError(
                    f"recording {images.name!r}: no training frames, which refresh a map; give a"
                    " folder of its images"
                )
        else:
            given = Images.of(images).images
            cameras = [camera] * len(given)
        with self._store.writing(), shown(on_progress) as step:
            scene, report = refresh_scene(self.localizer, given, cameras, options, step)
            self._store.refresh(scene, {**asdict(report), **recorded()})
        self._changed()
        return report

    def undo_refresh(self, scene: str) -> None:
        """Bring back the state of a scene before its last refresh.

        Raises:
            InputError: No such scene, nothing to undo, or another process writes into the map.
        """
        self._store.undo(scene)
        self._changed()

    def remove(self, *names: str) -> None:
        """Remove scenes, all in one step; the other scenes do not change.

        Raises:
            InputError: No such scene, or another process writes into the map.
        """
        from evercal.mapping.manage import remove_scenes

        remove_scenes(self._store, names)
        self._changed()

    def rename(self, name: str, new: str) -> None:
        """Give a scene another name.

        Raises:
            InputError: No such scene, a name that is taken or unusable, or another process writes
                into the map.
        """
        from evercal.mapping.manage import rename_scene

        rename_scene(self._store, name, new)
        self._changed()

    def merge(self, *others: PathLike, on_clash: OnClash = "refuse") -> Merged:
        """Add the scenes of other maps, all in one step; see `mapping.manage.merge_maps`.

        Raises:
            InputError: Not a map, another encoder or image size, a name that is taken, or another
                process writes into the map.
        """
        from evercal.learning.mapped_already import placed
        from evercal.mapping.manage import merge_maps

        def place(scene: SceneMap, contents: MapContents) -> SceneMap:
            return placed(scene, contents)[0]

        merged = merge_maps(self._store, others, on_clash, place)
        self._changed()
        return merged

    def pack(self, file: PathLike) -> None:
        """Write the map into one file, a zip archive; an existing file is replaced.

        Raises:
            InputError: No scene has been learned, or a file of the map is missing or was changed.
        """
        from evercal.mapping.manage import pack_map

        pack_map(self.path, Path(file))

    def _changed(self) -> None:
        """Forget the localizer of the scenes before a change."""
        self._localizer = None
