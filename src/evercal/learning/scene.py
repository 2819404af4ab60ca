"""A scene of a map from a recording: keyframes, landmarks, poses and their scatter."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.learning.stated_scatter import with_scatter
from evercal.localization.answer import differ
from evercal.localization.localizer import Localizer
from evercal.mapping.arm_offsets import with_offsets
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.built_map import Adjusted
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.processes import one_product_thread
from evercal.progress import OnProgress
from evercal.recordings import posed_recording
from evercal.recordings.frame import (
    MIN_GRIPPER_FRAMES,
    MIN_TRAIN_FRAMES,
    Frame,
    Recording,
    lacks_camera_poses,
)
from evercal.recordings.held_out import HeldOutSplit, require_frames, split_held_out
from evercal.recordings.pictures import look_at
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount

if TYPE_CHECKING:
    from evercal.calibration.hand_eye import HandEyeReport


@dataclass(frozen=True)
class LearnReport:
    """Outcome of learning a scene, as JSON values."""

    scene: str
    """Name of the scene."""
    seconds: float
    """Wall time."""
    memory_bytes: int
    """Size of the keyframes of all scenes."""
    frames_kept: int
    """Keyframes of this scene."""
    train_frames: int
    """Frames that were learned."""
    held_out_frames: int
    """Frames that the scatter of the stated poses was fitted to."""
    landmarks: int = 0
    """Landmarks of this scene."""
    adjusted: Adjusted | None = None
    """Changes by bundle adjustment; None for networks."""
    hand_eye: "HandEyeReport | None" = None
    """The estimated camera on the gripper; None where the recording states camera poses."""
    iterations: int = 0
    """Training steps; 0 for a map."""
    head_bytes: int = 0
    """Size of the networks; 0 for a map."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The inverse of `asdict`."""
        from evercal.calibration.hand_eye import HandEyeReport

        adjusted = values["adjusted"]
        hand_eye = values["hand_eye"]
        return cls(
            **{
                **values,
                "adjusted": adjusted and Adjusted(**adjusted),
                "hand_eye": hand_eye and HandEyeReport.from_dict(hand_eye),
            }
        )


@one_product_thread()
def learn_scene(
    recording: Recording,
    contents: MapContents,
    memory: str | int | None = None,
    gripper_from_camera: SE3 | None = None,
    options: MapOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
    mount: Mount = EYE_IN_HAND,
) -> tuple[SceneMap, LearnReport]:
    """Build the map of one scene and fit the scatter of its stated poses; nothing is written.

    Args:
        recording: Its training frames are learned; test frames are not read.
        contents: Encoder, and the scenes that the report counts. The new scene does not depend on
            them.
        memory: Keyframes to keep, as for `Map.learn`.
        gripper_from_camera: A rough one that the estimate is compared with.
        options: Sizes and priors of the map; `memory` overrides theirs.
        on_progress: Called with the current step, how much of it is done, and its total.
        mount: Of the camera, where the recording states gripper poses only. The map of a fixed
            camera is that of the thing that the gripper holds, in the frame of the gripper.
    """
    began = time.perf_counter()
    budget = MemoryBudget.parse(memory)
    options = options or MapOptions()
    start = None
    least = MIN_TRAIN_FRAMES
    if not (shown := look_at(recording.train)).usable:
        raise InputError(f"scene {recording.name!r}: {'; '.join(shown.warnings)}")
    whole = recording.train
    if lacks_camera_poses(recording):
        from evercal.calibration.hand_eye import posed_by_gripper

        recording, start = posed_by_gripper(
            recording, mount, contents.encoder, on_progress
        )
        options = replace(options.for_hand_eye(mount), arm=start.arm)
        least = MIN_GRIPPER_FRAMES
        budget = replace(budget, least=MIN_GRIPPER_FRAMES)
    recording = posed_recording(recording)
    require_frames(recording, least)
    split = split_held_out(recording.train)
    # A calibration, in which no image is to be located.
    if options.mount == EYE_TO_HAND:
        split = HeldOutSplit(recording.train, ())
    options = _sized(options, budget, contents.short_side)
    options = replace(options, metric=recording.metric)
    built = build_map(
        recording.name, split.train, contents.encoder, options, on_progress
    )
    if options.mount == EYE_TO_HAND:
        built = replace(built, scene=of_whole_images(built.scene, whole[0].camera))
    if budget.auto:
        from evercal.learning.fewest_keyframes import fewest_keyframes

        built = built.take(fewest_keyframes(contents, built, split.train, on_progress))
    scene = with_scatter(
        # Alone in a map, so that it does not depend on the other scenes.
        contents.empty().with_scene(built.scene),
        built.corrected(split.held_out),
        left_out=built.left_out(split.train),
        noise=built.independent_noise,
    )
    accused = [
        frame for frame in split.train if frame.name in built.adjusted.wrong_poses
    ]
    built = built.cleared(located_as_stated(contents, scene, built.corrected(accused)))
    report = LearnReport(
        scene=scene.name,
        seconds=time.perf_counter() - began,
        memory_bytes=contents.with_scene(scene).memory_bytes,
        frames_kept=len(scene.keyframes),
        train_frames=len(split.train),
        held_out_frames=len(split.held_out),
        landmarks=scene.landmarks,
        adjusted=built.adjusted
        if recording.metric
        else replace(built.adjusted, common_translation_mm=None, pose_sigma_mm=None),
    )
    if start is not None:
        from evercal.calibration.hand_eye import hand_eye_report, with_image_scatter

        # The frames of a fixed camera are windows by now.
        used = [frame for frame in whole if frame.base_from_gripper is not None]
        used = used if mount == EYE_TO_HAND else split.train
        hand_eye = hand_eye_report(start, built, used, gripper_from_camera)
        if mount == EYE_TO_HAND:
            others = [
                frame for frame in whole if frame.name not in built.keyframe_names
            ]
            localizer = Localizer(contents.empty().with_scene(scene))
            shown = others or whole
            if built.hand_eye is not None and built.hand_eye.arm is not None:
                shown = with_offsets(shown, built.hand_eye.arm)
            hand_eye = with_image_scatter(hand_eye, localizer, shown)
        report = replace(report, hand_eye=hand_eye)
    return scene, report


def of_whole_images(scene: SceneMap, whole: Camera) -> SceneMap:
    """The map of a thing in the gripper, with the camera of whole images instead of windows."""
    part = scene.camera
    adjusted = scene.adjusted_camera
    moved = adjusted.cx - part.cx, adjusted.cy - part.cy
    size = {"width": whole.width, "height": whole.height}
    adjusted = replace(adjusted, **size, cx=whole.cx + moved[0], cy=whole.cy + moved[1])
    return replace(
        scene, camera=whole, adjusted_camera=adjusted, parent_frame="gripper"
    )


def located_as_stated(
    contents: MapContents, scene: SceneMap, frames: Sequence[Frame]
) -> tuple[str, ...]:
    """Names of the frames that a map locates where their poses say."""
    localizer = Localizer(contents.empty().with_scene(scene))
    right = []
    for frame in frames:
        estimate, pose = localizer.located(frame.read_image(), frame.camera)
        assert frame.base_from_camera is not None, "a posed frame"
        stated = scene.frame.from_base(frame.base_from_camera)
        if estimate.status != "ok" or pose is None or differ(pose, stated):
            continue
        right.append(frame.name)
    return tuple(right)


def _sized(options: MapOptions, budget: MemoryBudget, short_side: int) -> MapOptions:
    if budget.auto:
        from evercal.learning.fewest_keyframes import MOST_SHARE

        budget = MemoryBudget(share=MOST_SHARE)
    return replace(options, memory=budget, size=replace(options.size, cells=short_side))
