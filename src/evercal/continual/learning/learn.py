"""`learn`: one more scene; `learn_jointly`: all frames of all scenes at once, as a reference."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from evercal.continual.learning.checkpoint import trained
from evercal.continual.learning.stage import OnEvent, StageOptions, unobserved
from evercal.continual.learning.stage_rows import StageRows
from evercal.continual.learning.surfaces import shared_depths, surface_points
from evercal.continual.methods.method import (
    FineTuning,
    FinishedScene,
    Method,
    StageStart,
)
from evercal.continual.networks.atlas import Atlas, Cell, camera_clusters
from evercal.continual.networks.buffer import FeatureBuffer, join
from evercal.continual.networks.head import Head, fresh_head
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import (
    LearnedScenes,
    SceneRecord,
    prototypes,
)
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.mapping.keyframes import store_keyframes
from evercal.recordings.frame import Frame, Recording, stated_poses
from evercal.typing import Array

WHITENING_ROWS = 20_000
"""Rows of the first scenes to which the whitening of a head is fitted."""


def learn(
    scenes: LearnedScenes,
    method: Method,
    recording: Recording,
    options: StageOptions,
    on_event: OnEvent = unobserved,
    folder: Path | None = None,
) -> LearnedScenes:
    """Learn one more scene from the training frames of a recording; `scenes` is not changed.

    Thresholds are not fitted yet. With a `folder`, a call that was killed goes on.
    """
    after = scenes.copy_for_training()
    teacher = None
    if after.heads:
        teacher = copy.deepcopy(after.heads[-1])
    rows = StageRows(after, options, on_event)
    atlas = after.atlas(options.grid_scenes)
    cell, buffer = _begun(rows, atlas, recording, method.head_per_scene)
    head = after.heads[-1]
    if head.scenes == 1:
        _whiten(head, [buffer], options.seed)
    memories = []
    if method.replays:
        memories = rows.remembered()
    start = StageStart(
        head=head,
        teacher=teacher,
        memories=memories,
        states=scenes.method_states,
        replay_rows=options.fit.replay_batch,
    )
    hooks = method.begin(start)
    trainer = HeadTrainer(head, [buffer], options.fit, options.seed, hooks)
    for progress in trained(trainer, method, folder):
        on_event(progress)
    after.scenes.append(trained_record(recording, cell, buffer))
    finish_scene(after, method, recording.train, lambda: buffer, options)
    return after


def learn_jointly(
    start: LearnedScenes,
    recordings: Sequence[Recording],
    options: StageOptions,
    on_event: OnEvent = unobserved,
    folder: Path | None = None,
) -> LearnedScenes:
    """Train one head on several scenes, with the steps and rows of the same number of stages.

    A step has the rows of one that learns a scene and replays others. `start` has no scenes and is
    not changed.
    """
    after = start.copy_for_training()
    fit = options.fit
    view = replace(options.encode.view, short_side=start.short_side)
    frames = [frame for recording in recordings for frame in recording.train]
    plan = replace(options.encode, view=view).limited(frames, start.encoder.stride)
    options = replace(options, encode=plan)
    encoder = StageRows(after, options, on_event)
    atlas = after.atlas(options.grid_scenes)
    buffers = [_begun(encoder, atlas, recording)[1] for recording in recordings]
    [head] = after.heads
    _whiten(head, buffers, options.seed)
    batch = fit.batch
    if len(recordings) > 1:
        batch += fit.replay_batch
    iterations = fit.iterations * len(recordings)
    whole = replace(fit, iterations=iterations, batch=batch)
    trainer = HeadTrainer(head, buffers, whole, options.seed)
    for progress in trained(trainer, FineTuning(), folder):
        on_event(progress)
    for number, recording in enumerate(recordings):
        cell = atlas.cells[number]
        after.scenes.append(trained_record(recording, cell, buffers[number]))
        after.keyframes.append(None)
        after.method_states.append({})
    return after


def _begun(
    rows: StageRows, atlas: Atlas, recording: Recording, separate: bool = False
) -> tuple[Cell, FeatureBuffer]:
    """Place a scene in the atlas, grow a head by it, and encode its frames."""
    after = rows.scenes
    options = rows.options
    frames = recording.train
    number = len(atlas.cells)
    positions = stated_poses(frames).translation_m
    cell = atlas.place(positions)
    head = _head_to_grow(after, separate, options)
    local = head.scenes
    centres = _new_centres(head, options, cell.atlas_from_base.apply(positions))
    head.grow(centres, options.seed + number)
    after.heads.append(head)
    buffer = rows.of_scene(local, cell, frames)
    if options.fit.surface_weight > 0:
        depths = shared_depths(
            after.cache, frames, after.encoder, after.short_side, rows.on_event
        )
        points = surface_points(buffer, frames, depths, after.encoder.stride)
        buffer.known = points.to(buffer.device)
    return cell, buffer


def _head_to_grow(scenes: LearnedScenes, separate: bool, options: StageOptions) -> Head:
    """The head of the earlier scenes; a new one for the first scene, and with `separate`."""
    if scenes.heads and not separate:
        return scenes.heads.pop()
    head = fresh_head(
        features=scenes.encoder.width,
        descriptor=scenes.descriptor.width,
        options=options.head,
        seed=options.seed,
    )
    return head.to(scenes.device)


def _new_centres(head: Head, options: StageOptions, positions_m: Array) -> Tensor:
    """(k, 3) centres that a scene adds, from its camera positions (n, 3) in the atlas."""
    if head.options.centres == "grow":
        count = head.options.centres_per_scene
        clusters = camera_clusters(positions_m, count, options.seed)
        return torch.from_numpy(clusters).float()
    if len(head.centres):
        return torch.zeros(0, 3)
    return torch.tensor(options.fixed_centres_m).reshape(-1, 3)


def _whiten(head: Head, buffers: Sequence[FeatureBuffer], seed: int) -> None:
    if not head.options.whiten:
        return
    generator = torch.Generator().manual_seed(seed)
    count = WHITENING_ROWS // len(buffers)
    rows = join([buffer.draw(count, generator) for buffer in buffers])
    head.whiten(rows.features)


def finish_scene(
    scenes: LearnedScenes,
    method: Method,
    frames: Sequence[Frame],
    rows: Callable[[], FeatureBuffer],
    options: StageOptions,
) -> None:
    """Select what is stored of the newest scene and add it to `scenes`, which has its record.

    `rows` returns the rows of its frames; the first views are not augmented.
    """
    newest = len(scenes.scenes) - 1
    head, local = scenes.head_for(newest)
    statistics = FrameStatistics(frames, head, rows, options.seed, newest)
    capacity = options.memory.capacity(frames, scenes.short_side)
    selected = method.select(statistics, capacity)
    keyframes = None
    if selected is not None:
        chosen = [frames[i] for i in selected]
        keyframes = store_keyframes(chosen, scenes.short_side)
        keyframes = keyframes.take(options.memory.fitting(keyframes))
    scenes.keyframes.append(keyframes)
    diffusion = 0.0
    if head.options.condition == "descriptor":
        diffusion = options.fit.diffusion
    remembered = partial(StageRows(scenes, options).of_keyframes, newest)
    finished = FinishedScene(head, local, rows, remembered, diffusion)
    scenes.method_states.append(method.after_scene(finished))


def trained_record(
    recording: Recording, cell: Cell, buffer: FeatureBuffer
) -> SceneRecord:
    """The record of a scene after training on the rows of a buffer."""
    frames = len(recording.train)
    return SceneRecord(
        name=recording.name,
        camera=recording.train[0].camera,
        cell=cell,
        prototypes=prototypes(buffer.tensors["descriptors"][:frames]),
        train_frames=frames,
    )
