"""Feature rows of a stage: of the new scene's frames, and of remembered keyframes."""

import time
from collections.abc import Generator, Sequence
from dataclasses import replace

import torch

from evercal.continual.learning.stage import Encoding, Event, StageOptions
from evercal.continual.learning.surfaces import shared_depths, surface_points
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import EncodePlan, FeatureBuffer, encode_frames
from evercal.continual.scenes import LearnedScenes
from evercal.continual.store import Checkpoint, Resume
from evercal.mapping.keyframes import Keyframes
from evercal.recordings.frame import Frame

CHECKPOINT_SECONDS = 10.0


class Pacer:
    """Decides when a checkpoint is due."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def due(self) -> bool:
        """Whether the interval has passed; if so, it starts again."""
        now = time.monotonic()
        if now - self._last < CHECKPOINT_SECONDS:
            return False
        self._last = now
        return True


def scene_buffer(
    number: int, cell: Cell, frames: Sequence[Frame], device: torch.device
) -> FeatureBuffer:
    """An empty buffer for a scene's frames.

    Args:
        number: of the scene in the head.
        cell: of the scene in the atlas.
        frames: their camera can be corrected if they share one without distortion.
        device: of the rows.
    """
    one = all(frame.camera == frames[0].camera for frame in frames)
    correctable = one and not frames[0].camera.distortion
    return FeatureBuffer(number, cell.atlas_from_base, correctable, device)


def encoded(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: EncodePlan,
    scenes: LearnedScenes,
    resume: Resume | None = None,
    pacer: Pacer | None = None,
) -> Generator[Event, None, None]:
    """Encode frames into a buffer; rows of an interrupted run are restored.

    Args:
        buffer: to fill.
        frames: posed frames.
        plan: views per frame.
        scenes: with encoder and descriptor.
        resume: rows that an interrupted run had encoded.
        pacer: when to yield checkpoints of new rows; never by default.
    """
    for rows in resume.rows if resume else ():
        buffer.restore(rows)
    total = len(frames) * plan.views_per_frame
    for done in encode_frames(buffer, frames, plan, scenes.encoder, scenes.descriptor):
        yield Encoding(done, total)
        if pacer is not None and pacer.due():
            yield Checkpoint(buffer.take_new(), {})
    if pacer is not None:
        new = buffer.take_new()
        if new:
            yield Checkpoint(new, {})


def add_surfaces(
    buffer: FeatureBuffer, frames: Sequence[Frame], scenes: LearnedScenes
) -> Generator[Event, None, None]:
    """Estimate the depths of frames, and set the known points of their rows in a full buffer."""
    depths = shared_depths(scenes.cache, frames, scenes.encoder, scenes.short_side)
    points = surface_points(buffer, frames, depths, scenes.encoder.stride)
    buffer.known = points.to(buffer.device)
    yield Encoding(buffer.views, buffer.views)


def view_plan(options: StageOptions, short_side: int) -> EncodePlan:
    """Views at the working size of the localizer."""
    return replace(options.encode, view=replace(options.encode.view, short_side=short_side))


def remembered(
    scenes: LearnedScenes, options: StageOptions
) -> Generator[Event, None, list[FeatureBuffer]]:
    """Encode the keyframes of all scenes for replay: one buffer per scene."""
    buffers = []
    for number, keyframes in enumerate(scenes.keyframes):
        if keyframes is None or not keyframes.images:
            continue
        buffers.append((yield from keyframe_rows(scenes, number, keyframes, options)))
    return buffers


def keyframe_rows(
    scenes: LearnedScenes, number: int, keyframes: Keyframes, options: StageOptions
) -> Generator[Event, None, FeatureBuffer]:
    """Encode a scene's keyframes for replay; the first views are not augmented."""
    _, local = scenes.head_for(number)
    atlas_from_base = scenes.scenes[number].cell.atlas_from_base
    buffer = FeatureBuffer(local, atlas_from_base, device=scenes.device)
    plan = view_plan(options, scenes.short_side)
    plan = replace(plan, views_per_frame=options.replay_views_per_frame)
    yield from encoded(buffer, keyframes.frames(), plan, scenes)
    return buffer
