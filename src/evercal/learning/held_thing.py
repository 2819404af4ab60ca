"""A fixed camera from images of a thing that the gripper holds, which becomes a scene."""

import time
from dataclasses import replace

from evercal.calibration.from_map.hand_eye import HandEye, hand_eye_of
from evercal.calibration.from_map.hand_eye_start import (
    HandEyeStart,
    gripper_frames,
    hand_eye_start,
)
from evercal.calibration.held_thing.moving_parts import moving_parts
from evercal.calibration.held_thing.slip import refuse_slip
from evercal.calibration.held_thing.thing_map import (
    in_windows,
    of_whole_images,
    with_image_scatter,
)
from evercal.errors import InputError
from evercal.learning.located import localizer_of, located_poses
from evercal.learning.posed import LearnedScene, cleared, require_usable, sized
from evercal.learning.report import LearnReport
from evercal.mapping.arm_offsets import with_offsets
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.processes import one_product_thread
from evercal.progress import OnProgress
from evercal.recordings import posed_recording
from evercal.recordings.frame import (
    MIN_GRIPPER_FRAMES,
    Recording,
    lacks_camera_poses,
)
from evercal.recordings.held_out import HeldOutSplit, require_frames
from evercal.robot.mount import EYE_TO_HAND


@one_product_thread()
def learn_held_thing(
    recording: Recording,
    contents: MapContents,
    on_progress: OnProgress = lambda *_: None,
) -> tuple[SceneMap, LearnReport]:
    """Map a thing in the frame of the gripper, and calibrate the fixed camera that observes it.

    Nothing is written.

    Args:
        recording: Images of the fixed camera with gripper poses; test frames are not read.
        contents: Encoder, and the scenes that the report counts.
        on_progress: Called with the current step, how much of it is done, and its total.
    """
    began = time.perf_counter()
    require_usable(recording)
    if not lacks_camera_poses(recording):
        require_frames(posed_recording(recording))
        raise InputError(
            f"scene {recording.name!r}: states camera poses; a camera is calibrated by a thing in"
            " the gripper from a recording that states gripper poses only"
        )
    posed, start = _posed_by_gripper(recording, contents, on_progress)
    budget = replace(MemoryBudget.parse(None), least=MIN_GRIPPER_FRAMES)
    options = replace(MapOptions().for_hand_eye(EYE_TO_HAND), arm=start.arm)
    options = sized(options, budget, contents)
    options = replace(options, metric=recording.metric)
    encoder = contents.encoder
    built = build_map(recording.name, posed.train, encoder, options, on_progress)
    scene = of_whole_images(built.scene, recording.train[0].camera)
    built = cleared(replace(built, scene=scene), scene, posed.train, contents)
    # No frame is held out: no image is to be located.
    split = HeldOutSplit(posed.train, ())
    learned = LearnedScene(scene, built, split, recording.metric)
    report = learned.report(contents, began)
    estimate = _estimate(learned, start, recording, contents)
    return scene, replace(report, hand_eye=estimate)


def _posed_by_gripper(
    recording: Recording, contents: MapContents, on_progress: OnProgress
) -> tuple[Recording, HandEyeStart]:
    """Windows around the thing with rough camera poses, and the first estimate."""
    frames, _ = moving_parts(gripper_frames(recording))
    encoder = contents.encoder
    try:
        start = hand_eye_start(recording, frames, EYE_TO_HAND, encoder, on_progress)
    except InputError as error:
        raise InputError(f"{recording.name}: {error}") from None
    return in_windows(start.posed(recording, frames), start), start


def _estimate(
    learned: LearnedScene,
    start: HandEyeStart,
    recording: Recording,
    contents: MapContents,
) -> HandEye:
    """The calibration, with the scatter of whole images in the finished map."""
    built = learned.built
    frames = gripper_frames(recording)
    refuse_slip(frames, built)
    estimate = hand_eye_of(start, built, frames)
    keyframes = built.keyframe_names
    shown = [frame for frame in recording.train if frame.name not in keyframes]
    shown = shown or list(recording.train)
    if built.hand_eye is not None and built.hand_eye.arm is not None:
        shown = with_offsets(shown, built.hand_eye.arm)
    shown = [frame for frame in shown if frame.base_from_gripper is not None]
    localizer = localizer_of(contents, learned.scene)
    return with_image_scatter(estimate, shown, located_poses(localizer, shown))
