"""Feature rows for a stage: those of the new scene's frames, and of remembered keyframes."""

import time
from collections.abc import Generator, Sequence
from dataclasses import replace

import torch

from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import EncodePlan, FeatureBuffer, encode_frames
from evercal.continual.stage import Encoding, Event, StageOptions
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.scene_maps import SceneMaps
from evercal.mapping.store import Checkpoint, Resume
from evercal.recordings.frame import Frame

CHECKPOINT_SECONDS = 10.0


class Pacer:
    """Says when a checkpoint is due."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def due(self) -> bool:
        """Whether the last one is long enough ago; then this counts as one."""
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
        cell: where the scene lies in the atlas.
        frames: whose camera may be corrected if one without known distortion took them all.
        device: where its rows are used.
    """
    one = all(frame.camera == frames[0].camera for frame in frames)
    correctable = one and not frames[0].camera.distortion
    return FeatureBuffer(number, cell.atlas_from_base, correctable, device)


def encoded(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    plan: EncodePlan,
    maps: SceneMaps,
    resume: Resume | None = None,
    pacer: Pacer | None = None,
) -> Generator[Event, None, None]:
    """Encodes frames into a buffer, those that an interrupted run left to do.

    Args:
        buffer: filled.
        frames: posed.
        plan: which views.
        maps: whose encoder and descriptor.
        resume: rows that an interrupted run had encoded.
        pacer: when to yield checkpoints of what is new; None never.
    """
    for rows in resume.rows if resume else ():
        buffer.restore(rows)
    total = len(frames) * plan.views_per_frame
    for done in encode_frames(buffer, frames, plan, maps.encoder, maps.descriptor):
        yield Encoding(done, total)
        if pacer is not None and pacer.due():
            yield Checkpoint(buffer.take_new(), {})
    if pacer is not None:
        new = buffer.take_new()
        if new:
            yield Checkpoint(new, {})


def view_plan(options: StageOptions, short_side: int) -> EncodePlan:
    """Views at the size at which the localizer will see images."""
    return replace(options.encode, view=replace(options.encode.view, short_side=short_side))


def remembered(
    maps: SceneMaps, options: StageOptions
) -> Generator[Event, None, list[FeatureBuffer]]:
    """Encodes the keyframes of all scenes, as they are replayed: one buffer a scene."""
    buffers = []
    for number, keyframes in enumerate(maps.keyframes):
        if keyframes is None or not keyframes.images:
            continue
        buffers.append((yield from keyframe_rows(maps, number, keyframes, options)))
    return buffers


def keyframe_rows(
    maps: SceneMaps, number: int, keyframes: Keyframes, options: StageOptions
) -> Generator[Event, None, FeatureBuffer]:
    """Encodes a scene's keyframes as they are replayed; the first pass shows them as they are."""
    _, local = maps.head_for(number)
    place = maps.scenes[number].cell.atlas_from_base
    buffer = FeatureBuffer(local, place, device=maps.device)
    plan = view_plan(options, maps.short_side)
    plan = replace(plan, views_per_frame=options.replay_views_per_frame)
    yield from encoded(buffer, keyframes.frames(), plan, maps)
    return buffer
