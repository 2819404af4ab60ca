"""A fixed camera from images of a thing that the gripper holds, which becomes a scene."""

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

from evercal.calibration.from_map.hand_eye import hand_eye_of
from evercal.calibration.from_map.hand_eye_start import (
    SURE_SHARE,
    HandEyeStart,
    gripper_frames,
    hand_eye_start,
)
from evercal.calibration.held_thing.background import background_motion
from evercal.calibration.held_thing.moving_parts import (
    in_full_size,
    moving_parts,
    reduced,
)
from evercal.calibration.held_thing.slip import motion_warnings
from evercal.calibration.held_thing.thing_map import (
    in_windows,
    of_whole_images,
    with_image_scatter,
)
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.learning.posed import LearnedScene, cleared, require_usable, sized
from evercal.learning.report import LearnReport
from evercal.learning.stated_scatter import localizer_of, located_poses
from evercal.mapping.arm_offsets import with_offsets
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.built_map import BuiltMap
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.processes import one_product_thread
from evercal.progress import OnProgress
from evercal.recordings import posed_recording
from evercal.recordings.frame import (
    MIN_TRAIN_FRAMES,
    Frame,
    Recording,
    lacks_camera_poses,
)
from evercal.recordings.held_out import HeldOutSplit, require_frames
from evercal.robot.mount import EYE_TO_HAND
from evercal.robot.pose_errors import ArmErrors

WHOLE_SIDE = 960
"""Short side of the images whose features are matched, pixels, where reduced ones do not suffice:
the thing may be small."""


@one_product_thread()
def learn_held_thing(
    recording: Recording,
    contents: MapContents,
    on_progress: OnProgress,
    errors: ArmErrors | None,
) -> tuple[SceneMap, LearnReport]:
    """Map a thing in the frame of the gripper, and calibrate the fixed camera that observes it.

    Nothing is written.

    Args:
        recording: Images of the fixed camera with gripper poses; test frames are not read.
        contents: Encoder, and the scenes that the report counts.
        on_progress: Called with the current step, how much of it is done, and its total.
        errors: What is known of the arm.
    """
    began = perf_counter()
    if not lacks_camera_poses(recording):
        require_frames(posed_recording(recording))
        raise InputError(
            f"scene {recording.name!r}: states camera poses; a camera is calibrated by a thing in"
            " the gripper from a recording that states gripper poses only"
        )
    frames = gripper_frames(recording)
    small = [reduced(frame, WorkingSize().patches) for frame in frames]
    require_usable(replace(recording, train=tuple(small)))
    moving, _ = moving_parts(small)
    whole = [in_full_size(*pair) for pair in zip(moving, frames, strict=True)]
    start = _start(recording, moving, whole, contents.encoder, on_progress)
    posed = in_windows(start.posed(recording, moving), whole, start)
    budget = replace(MemoryBudget.parse(None), least=MIN_TRAIN_FRAMES)
    options = MapOptions().for_hand_eye(EYE_TO_HAND)
    options = replace(
        options,
        arm=start.arm,
        confirmed=tuple(start.confirmed),
        whole=recording.train[0].camera,
        errors=errors or ArmErrors(),
    )
    options = sized(options, budget, contents)
    options = replace(options, metric=recording.metric, names=recording.frames)
    encoder = contents.encoder
    built = build_map(recording.name, posed.train, encoder, options, on_progress)
    scene = of_whole_images(built.scene, recording.train[0].camera)
    built = cleared(replace(built, scene=scene), scene, posed.train, contents)
    # No frame is held out: no image is to be located.
    split = HeldOutSplit(posed.train, ())
    learned = LearnedScene(scene, built, split, recording.metric)
    report = learned.report(contents, began)
    warnings = motion_warnings(frames, built, background_motion(moving))
    estimate = hand_eye_of(start, built, frames, warnings=warnings)
    shown = _to_locate(small, built)
    poses = located_poses(localizer_of(contents, scene), shown)
    estimate = with_image_scatter(estimate, shown, poses)
    return scene, replace(report, hand_eye=estimate)


def _start(
    recording: Recording,
    reduced: Sequence[Frame],
    whole: Sequence[Frame],
    encoder: Encoder,
    on_progress: OnProgress,
) -> HandEyeStart:
    """The first estimate, from reduced images where they suffice."""
    try:
        start = hand_eye_start(recording, reduced, EYE_TO_HAND, encoder, on_progress)
        if start.pairs >= max(len(reduced), SURE_SHARE * start.of_pairs):
            return start
    except InputError:
        pass
    try:
        return hand_eye_start(
            recording, whole, EYE_TO_HAND, encoder, on_progress, WHOLE_SIDE
        )
    except InputError as error:
        raise InputError(f"{recording.name}: {error}") from None


def _to_locate(frames: Sequence[Frame], built: BuiltMap) -> list[Frame]:
    """Frames to locate in the finished map: those that are no keyframes, if there are any."""
    others = [frame for frame in frames if frame.name not in built.keyframe_names]
    others = others or list(frames)
    if built.hand_eye and built.hand_eye.arm:
        return with_offsets(others, built.hand_eye.arm)
    return others
