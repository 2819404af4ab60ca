"""Feature rows of a stage: of the new scene's frames, and of remembered keyframes."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from evercal.continual.learning.stage import Encoding, OnEvent, StageOptions, unobserved
from evercal.continual.learning.surfaces import shared_depths, surface_points
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import EncodePlan, FeatureBuffer, encode_frames
from evercal.continual.scenes import LearnedScenes
from evercal.mapping.keyframes import Keyframes
from evercal.recordings.frame import Frame


def scene_buffer(
    number: int, cell: Cell, frames: Sequence[Frame], device: torch.device
) -> FeatureBuffer:
    """An empty buffer for the frames of scene `number` of the head.

    The camera can be corrected if the frames share one without distortion.
    """
    one = all(frame.camera == frames[0].camera for frame in frames)
    correctable = one and not frames[0].camera.distortion
    return FeatureBuffer(number, cell.atlas_from_base, correctable, device)


def encode_rows(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: EncodePlan,
    scenes: LearnedScenes,
    on_event: OnEvent = unobserved,
) -> None:
    """Encode frames into a buffer with the encoder and descriptor of `scenes`."""
    total = len(frames) * plan.views_per_frame
    for done in encode_frames(buffer, frames, plan, scenes.encoder, scenes.descriptor):
        on_event(Encoding(done, total))


def add_surfaces(buffer: FeatureBuffer, frames: Sequence[Frame], scenes: LearnedScenes) -> None:
    """Estimate the depths of frames, and set the known points of their rows in a full buffer."""
    depths = shared_depths(scenes.cache, frames, scenes.encoder, scenes.short_side)
    points = surface_points(buffer, frames, depths, scenes.encoder.stride)
    buffer.known = points.to(buffer.device)


def view_plan(options: StageOptions, short_side: int) -> EncodePlan:
    """Views at the working size of the localizer."""
    return replace(options.encode, view=replace(options.encode.view, short_side=short_side))


def remembered(
    scenes: LearnedScenes, options: StageOptions, on_event: OnEvent
) -> list[FeatureBuffer]:
    """Encode the keyframes of all scenes for replay: one buffer per scene."""
    return [
        keyframe_rows(scenes, number, keyframes, options, on_event)
        for number, keyframes in enumerate(scenes.keyframes)
        if keyframes is not None and keyframes.images
    ]


def keyframe_rows(
    scenes: LearnedScenes,
    number: int,
    keyframes: Keyframes,
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> FeatureBuffer:
    """Encode a scene's keyframes for replay; the first views are not augmented."""
    _, local = scenes.head_for(number)
    atlas_from_base = scenes.scenes[number].cell.atlas_from_base
    buffer = FeatureBuffer(local, atlas_from_base, device=scenes.device)
    plan = view_plan(options, scenes.short_side)
    plan = replace(plan, views_per_frame=options.replay_views_per_frame)
    encode_rows(buffer, keyframes.frames(), plan, scenes, on_event)
    return buffer
