"""Feature rows of a stage: of the new scene's frames, and of remembered keyframes."""

from collections.abc import Sequence
from dataclasses import replace

from evercal.continual.learning.stage import Encoding, OnEvent, StageOptions, unobserved
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import EncodePlan, FeatureBuffer, encode_frames
from evercal.continual.scenes import LearnedScenes
from evercal.mapping.keyframes import Keyframes
from evercal.recordings.frame import Frame


def scene_rows(
    scenes: LearnedScenes,
    local: int,
    cell: Cell,
    frames: Sequence[Frame],
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> FeatureBuffer:
    """Encode the training frames of a scene; `local` is its index in the head.

    The camera can be corrected if the frames share one without distortion.
    """
    one = all(frame.camera == frames[0].camera for frame in frames)
    correctable = one and not frames[0].camera.distortion
    buffer = FeatureBuffer(local, cell.atlas_from_base, correctable, scenes.device)
    _encode(buffer, frames, options.encode, scenes, on_event)
    return buffer


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
    plan = replace(options.encode, views_per_frame=options.replay_views_per_frame)
    _encode(buffer, keyframes.frames(), plan, scenes, on_event)
    return buffer


def _encode(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: EncodePlan,
    scenes: LearnedScenes,
    on_event: OnEvent,
) -> None:
    plan = replace(plan, view=replace(plan.view, short_side=scenes.short_side))
    total = len(frames) * plan.views_per_frame
    for done in encode_frames(buffer, frames, plan, scenes.encoder, scenes.descriptor):
        on_event(Encoding(done, total))
