"""Training on all frames of all scenes at once: a reference for continual methods."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from evercal.continual.learning.finish_scene import finished_stage, trained_record
from evercal.continual.learning.stage import OnEvent, Stage, StageOptions, unobserved
from evercal.continual.learning.stage_head import head_for_all, whiten
from evercal.continual.learning.stage_rows import (
    add_surfaces,
    encode_rows,
    scene_buffer,
    view_plan,
)
from evercal.continual.methods.method import Method
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import LearnedScenes
from evercal.recordings.frame import Recording, stated_poses


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
