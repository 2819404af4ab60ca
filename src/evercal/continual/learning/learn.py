"""`learn`: one more scene; `learn_jointly`: all frames of all scenes at once, as a reference."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from evercal.continual.learning.finish_scene import correct_lens, finished_stage, trained_record
from evercal.continual.learning.stage import OnEvent, Stage, StageOptions, unobserved
from evercal.continual.learning.stage_head import head_for_all, head_for_scene, whiten
from evercal.continual.learning.stage_rows import (
    add_surfaces,
    encode_rows,
    remembered,
    scene_buffer,
    view_plan,
)
from evercal.continual.methods.method import Method, StageStart
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import LearnedScenes
from evercal.recordings.frame import Recording, stated_poses


def learn(
    scenes: LearnedScenes,
    method: Method,
    recording: Recording,
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> Stage:
    """Learn one more scene.

    Args:
        scenes: what was learned before; not changed.
        method: how the network is trained.
        recording: its training frames are learned, its test frames are not read.
        options: of the stage.
        on_event: called for progress bars.
    """
    after, frames = scenes.copy_for_training(), recording.train
    teacher = copy.deepcopy(after.heads[-1]).eval() if after.heads else None
    positions = stated_poses(frames).translation_m
    cell = after.atlas(options.grid_scenes).place(positions)
    in_atlas = cell.atlas_from_base.apply(positions)
    head, local = head_for_scene(after, method.head_per_scene, options, in_atlas)
    buffer = scene_buffer(local, cell, frames, scenes.device)
    encode_rows(buffer, frames, view_plan(options, scenes.short_side), scenes, on_event)
    if options.fit.surface_weight > 0:
        add_surfaces(buffer, frames, scenes)
    if teacher is None:
        whiten(head, [buffer], options.seed)
    memories = remembered(scenes, options, on_event) if method.replays else []
    rows, states = options.fit.replay_batch, scenes.method_states
    hooks = method.begin(StageStart(head, teacher, memories, states, rows, options.seed))
    trainer = HeadTrainer(head, [buffer], options.fit, options.seed, hooks)
    for progress in trainer.run():
        on_event(progress)
    after.scenes.append(trained_record(recording, cell, trainer, 0))
    correct_lens(buffer, after.scenes[-1])
    return finished_stage(after, method, frames, lambda: buffer, options)


def learn_jointly(
    start: LearnedScenes,
    recordings: Sequence[Recording],
    options: StageOptions,
    on_event: OnEvent = unobserved,
) -> Stage:
    """Train one head on several scenes, with the steps and rows of the same number of stages.

    A step has the rows of one that learns a scene and replays others.

    Args:
        start: without scenes; not changed.
        recordings: their training frames are learned.
        options: of one stage.
        on_event: called for progress bars.

    Returns:
        The stage of all scenes.
    """
    after, fit = start.copy_for_training(), options.fit
    plan = view_plan(options, start.short_side)
    cells, positions, buffers = [], [], []
    atlas = after.atlas(options.grid_scenes)
    for number, recording in enumerate(recordings):
        cameras = stated_poses(recording.train).translation_m
        cells.append(atlas.place(cameras))
        positions.append(cells[-1].atlas_from_base.apply(cameras))
        buffers.append(scene_buffer(number, cells[-1], recording.train, start.device))
        encode_rows(buffers[-1], recording.train, plan, start, on_event)
        if fit.surface_weight > 0:
            add_surfaces(buffers[-1], recording.train, start)
    head = head_for_all(after, options, positions)
    whiten(head, buffers, options.seed)
    rows = fit.batch + (fit.replay_batch if len(recordings) > 1 else 0)
    whole = replace(fit, iterations=fit.iterations * len(recordings), batch=rows)
    trainer = HeadTrainer(head, buffers, whole, options.seed)
    for progress in trainer.run():
        on_event(progress)
    for number, recording in enumerate(recordings):
        after.scenes.append(trained_record(recording, cells[number], trainer, number))
        rows_of = partial(buffers.__getitem__, number)
        finished_stage(after, Method(), recording.train, rows_of, options)
    return Stage(after, whole.iterations, 0)
