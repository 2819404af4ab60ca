"""`learn`: one more scene; `learn_jointly`: all frames of all scenes at once, as a reference."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from evercal.continual.learning.stage import OnEvent, StageOptions, unobserved
from evercal.continual.learning.stage_rows import StageRows
from evercal.continual.learning.surfaces import shared_depths, surface_points
from evercal.continual.methods.method import FinishedScene, Method, StageStart
from evercal.continual.networks.atlas import Atlas, Cell, camera_clusters
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head, fresh_head
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import (
    LearnedScenes,
    SceneRecord,
    corrected_camera,
    prototypes,
)
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.mapping.keyframes import store_keyframes
from evercal.recordings.frame import Frame, Recording, stated_poses

WHITENING_ROWS = 20_000


def learn(
    scenes: LearnedScenes,
    method: Method,
    recording: Recording,
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> LearnedScenes:
    """Learn one more scene from the training frames of a recording; `scenes` is not changed.

    Thresholds are not fitted yet.
    """
    after = scenes.copy_for_training()
    teacher = copy.deepcopy(after.heads[-1]).eval() if after.heads else None
    rows = StageRows(after, options, on_event)
    atlas = after.atlas(options.grid_scenes)
    cell, buffer = _begun(rows, atlas, recording, method.head_per_scene)
    head = after.heads[-1]
    if teacher is None:
        _whiten(head, [buffer], options.seed)
    memories = rows.remembered() if method.replays else []
    states = scenes.method_states
    replayed = options.fit.replay_batch
    hooks = method.begin(
        StageStart(head, teacher, memories, states, replayed, options.seed)
    )
    trainer = HeadTrainer(head, [buffer], options.fit, options.seed, hooks)
    for progress in trainer.run():
        on_event(progress)
    after.scenes.append(trained_record(recording, cell, trainer, 0))
    after.scenes[-1].correct_lens(buffer)
    finish_scene(after, method, recording.train, lambda: buffer, options)
    return after


def learn_jointly(
    start: LearnedScenes,
    recordings: Sequence[Recording],
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> LearnedScenes:
    """Train one head on several scenes, with the steps and rows of the same number of stages.

    A step has the rows of one that learns a scene and replays others. `start` has no scenes and is
    not changed.
    """
    after = start.copy_for_training()
    fit = options.fit
    encoder = StageRows(after, options, on_event)
    atlas = after.atlas(options.grid_scenes)
    begun = [_begun(encoder, atlas, scene) for scene in recordings]
    buffers = [buffer for _, buffer in begun]
    (head,) = after.heads
    _whiten(head, buffers, options.seed)
    rows = fit.batch + (fit.replay_batch if len(recordings) > 1 else 0)
    whole = replace(fit, iterations=fit.iterations * len(recordings), batch=rows)
    trainer = HeadTrainer(head, buffers, whole, options.seed)
    for progress in trainer.run():
        on_event(progress)
    for number, (recording, (cell, _)) in enumerate(
        zip(recordings, begun, strict=True)
    ):
        after.scenes.append(trained_record(recording, cell, trainer, number))
        after.keyframes.append(None)
        after.method_states.append({})
    return after


def _begun(
    rows: StageRows, atlas: Atlas, recording: Recording, own: bool = False
) -> tuple[Cell, FeatureBuffer]:
    """Place a scene in the atlas, grow a head by it, and encode its frames."""
    after = rows.scenes
    options = rows.options
    frames = recording.train
    number = len(atlas.cells)
    positions = stated_poses(frames).translation_m
    cell = atlas.place(positions)
    head = _head_to_grow(after, own, options)
    local = head.scenes
    centres = _new_centres(head, options, cell.atlas_from_base.apply(positions))
    head.grow(centres, options.seed + number)
    after.heads.append(head)
    buffer = rows.of_scene(local, cell, frames)
    if options.fit.surface_weight > 0:
        depths = shared_depths(after.cache, frames, after.encoder, after.short_side)
        points = surface_points(buffer, frames, depths, after.encoder.stride)
        buffer.known = points.to(buffer.device)
    return cell, buffer


def _head_to_grow(scenes: LearnedScenes, own: bool, options: StageOptions) -> Head:
    """A new head, the last one, or with `own` a copy of its weights without scenes."""
    if not scenes.heads:
        widths = scenes.encoder.width, scenes.descriptor.width
        return fresh_head(*widths, options.head, options.seed).to(scenes.device)
    return scenes.heads[-1].without_scenes() if own else scenes.heads.pop()


def _new_centres(head: Head, options: StageOptions, positions_m: np.ndarray) -> Tensor:
    """(k, 3) centres that a scene adds, from its camera positions (n, 3) in the atlas."""
    if head.options.centres == "grow":
        count = head.options.centres_per_scene
        return torch.from_numpy(
            camera_clusters(positions_m, count, options.seed)
        ).float()
    if len(head.centres):
        return torch.zeros(0, 3)
    return torch.tensor(options.fixed_centres_m).reshape(-1, 3)


def _whiten(head: Head, buffers: Sequence[FeatureBuffer], seed: int) -> None:
    if not head.options.whiten:
        return
    generator = torch.Generator().manual_seed(seed)
    drawn = [
        buffer.draw(WHITENING_ROWS // len(buffers), generator) for buffer in buffers
    ]
    head.whiten(torch.cat([rows.features for rows in drawn]))


def finish_scene(
    scenes: LearnedScenes,
    method: Method,
    frames: Sequence[Frame],
    rows: Callable[[], FeatureBuffer],
    options: StageOptions,
) -> None:
    """Select what is stored of the newest scene and add it to `scenes`, which has its record.

    `rows` returns the rows of its frames with the intrinsics of the training; the first views are
    not augmented.
    """
    newest = len(scenes.scenes) - 1
    head, local = scenes.head_for(newest)
    statistics = FrameStatistics(frames, head, rows, options.seed, newest)
    selected = method.select(
        statistics, options.memory.capacity(frames, scenes.short_side)
    )
    keyframes = None
    if selected is not None:
        chosen = [frames[i] for i in selected]
        refined = scenes.scenes[-1].refined_camera
        if refined is not None:  # replay uses the camera as training corrected it
            chosen = [replace(frame, camera=refined) for frame in chosen]
        keyframes = store_keyframes(chosen, scenes.short_side)
        keyframes = keyframes.take(options.memory.fitting(keyframes))
    scenes.keyframes.append(keyframes)
    diffusion = options.fit.diffusion if head.options.condition == "descriptor" else 0.0
    remembered = partial(StageRows(scenes, options).of_keyframes, newest)
    finished = FinishedScene(head.eval(), local, rows, remembered, diffusion)
    scenes.method_states.append(method.after_scene(finished))


def trained_record(
    scene: Recording, cell: Cell, trainer: HeadTrainer, number: int
) -> SceneRecord:
    """The record of a scene after training; its rows are in the trainer's buffer `number`."""
    buffer = trainer.buffers[number]
    options = trainer.options
    camera = scene.train[0].camera
    refined = None
    if options.intrinsics_rate > 0 and options.iterations > 0 and buffer.correctable:
        refined = corrected_camera(camera, trainer.correction[number].detach())
    spread = prototypes(buffer.tensors["descriptors"][: len(scene.train)])
    return SceneRecord(scene.name, camera, cell, spread, len(scene.train), refined)
