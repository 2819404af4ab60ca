"""A scene from a camera on the gripper whose recording states gripper poses only."""

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

from evercal.calibration.from_map.hand_eye import hand_eye_of
from evercal.calibration.from_map.hand_eye_start import (
    HandEyeStart,
    gripper_frames,
    hand_eye_start,
)
from evercal.calibration.held_thing.moving_parts import moving_parts
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.learning.posed import learn_posed
from evercal.learning.report import LearnReport
from evercal.learning.stated_scatter import LEAST_ANSWERS
from evercal.mapping.build import MapOptions
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.progress import OnProgress
from evercal.recordings.fixed_pixels import without_fixed_pixels
from evercal.recordings.frame import MIN_TRAIN_FRAMES, Frame, Recording
from evercal.recordings.held_out import HeldOutSplit, split_held_out
from evercal.robot.mount import EYE_IN_HAND

STILL_SHARE = 0.3
"""Share of the texture that stands still before a fixed camera; the gripper shows a wrist camera
less of itself."""


def learn_wrist(
    recording: Recording,
    contents: MapContents,
    budget: MemoryBudget,
    gripper_from_camera: SE3 | None,
    options: MapOptions,
    on_progress: OnProgress,
) -> tuple[SceneMap, LearnReport]:
    """Estimate `gripper_from_camera`, build the map of the scene, and refine both together.

    `gripper_from_camera` is a rough one that the estimate is compared with.
    """
    began = perf_counter()
    frames = gripper_frames(recording)
    shown, fixed_share = without_fixed_pixels(recording)
    try:
        posed, start = _posed_by_gripper(shown, contents, on_progress)
    except InputError as error:
        raise InputError(f"{recording.name}: {error}{_still(frames)}") from None
    split = split_held_out(posed.train)
    if len(split.held_out) < LEAST_ANSWERS:
        split = HeldOutSplit(posed.train, ())
    budget = replace(budget, least=MIN_TRAIN_FRAMES)
    options = replace(options.for_hand_eye(EYE_IN_HAND), arm=start.arm)
    learned = learn_posed(posed, split, contents, budget, options, on_progress)
    report = learned.report(contents, began, fixed_share)
    hand_eye = hand_eye_of(start, learned.built, posed.train, gripper_from_camera)
    return learned.scene, replace(report, hand_eye=hand_eye)


def _posed_by_gripper(
    recording: Recording, contents: MapContents, on_progress: OnProgress
) -> tuple[Recording, HandEyeStart]:
    """The recording with rough camera poses, and the first estimate that they are from."""
    frames = gripper_frames(recording)
    encoder = contents.encoder
    start = hand_eye_start(recording, frames, EYE_IN_HAND, encoder, on_progress)
    return start.posed(recording, frames), start


def _still(frames: Sequence[Frame]) -> str:
    """A hint where the camera looks fixed."""
    still = moving_parts(frames)[1]
    if still < STILL_SHARE:
        return ""
    return (
        f"; {100 * still:.0f} % of what the images show stands still: 'evercal eye-to-hand'"
        " calibrates a fixed camera by a thing in the gripper"
    )
