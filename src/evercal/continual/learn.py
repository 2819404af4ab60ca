"""`learn`: one more scene, as a generator of progress, checkpoints and the finished stage."""

import copy
from collections.abc import Iterator
from dataclasses import replace

import torch

from evercal.continual.finish_scene import (
    Learned,
    correct_lens,
    finished_stage,
    mapped_record,
    trained_record,
)
from evercal.continual.methods.method import StageStart
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.stage import Event, Stage, StageOptions
from evercal.continual.stage_head import head_for_scene, whiten
from evercal.continual.stage_map import stage_map
from evercal.continual.stage_rows import Pacer, encoded, remembered, scene_buffer, view_plan
from evercal.continual.strategies import Strategy
from evercal.localization.fewest_keyframes import AutoMemoryOptions, fewest_keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.mapping.store import Checkpoint, Resume
from evercal.recordings.frame import Recording, stated_poses


def learn(
    maps: SceneMaps,
    strategy: Strategy,
    scene: Recording,
    options: StageOptions,
    resume: Resume | None = None,
) -> Iterator[Event]:
    """Learns one more scene.

    Args:
        maps: what is known so far; not changed.
        strategy: what is learned; one that learns jointly has its own function, `learn_jointly`.
        scene: its training frames are learned, its test frames are not looked at.
        options: how.
        resume: where an interrupted run of the same call stood.

    Yields:
        `Encoding` and `Progress` as it goes, a `Checkpoint` every 10 seconds, a `Stage` at the end.
    """
    method = strategy.method
    if method is None:
        yield from _learn_map(maps, scene, options)
        return
    after, frames, scene_map = maps.copy_for_training(), scene.train, None
    if strategy.builds_map:
        scene_map = yield from stage_map(after, frames, options)
        frames = scene_map.adjusted_frames(frames)
    teacher = copy.deepcopy(after.heads[-1]).eval() if after.heads else None
    positions = stated_poses(frames).translation_m
    cell = after.atlas(options.grid_scenes).place(positions)
    in_atlas = cell.atlas_from_base.apply(positions)
    head, local = head_for_scene(after, method.head_per_scene, options, in_atlas)
    buffer, pacer = scene_buffer(local, cell, frames, maps.device), Pacer()
    plan = view_plan(options, maps.short_side)
    yield from encoded(buffer, frames, plan, maps, resume, pacer)
    if teacher is None:
        whiten(head, [buffer], options.seed)
    memories = (yield from remembered(maps, options)) if method.replays else []
    rows, states = options.fit.replay_batch, maps.method_states
    hooks = method.begin(StageStart(head, teacher, memories, states, rows, options.seed))
    fit = options.fit if scene_map is None else options.fit.with_known_lens()
    trainer = HeadTrainer(head, [buffer], fit, options.seed, hooks)
    if resume is not None and resume.trainer:
        trainer.load(dict(resume.trainer))
    for progress in trainer.run():
        yield progress
        if pacer.due():
            yield Checkpoint({}, trainer.state())
    after.scenes.append(trained_record(scene, cell, trainer, 0, len(frames)))
    correct_lens(buffer, after.scenes[-1])
    done = Learned(frames, lambda: buffer, hooks, scene_map)
    yield finished_stage(after, method, done, options)


def _learn_map(maps: SceneMaps, scene: Recording, options: StageOptions) -> Iterator[Event]:
    """Learns a scene by building its map; nothing is trained."""
    after, frames = maps.copy_for_training(), scene.train
    cell = after.atlas(options.grid_scenes).place(stated_poses(frames).translation_m)
    if options.memory_auto:
        options = replace(options, memory_share=AutoMemoryOptions().most, memory_bytes=None)
    scene_map = yield from stage_map(after, frames, options)
    nothing = torch.zeros(0, after.descriptor.width).half()
    record = SceneRecord(scene.name, frames[0].camera, cell, nothing, len(frames))
    after.scenes.append(mapped_record(record, scene_map))
    after.keyframes.append(scene_map.keyframes)
    after.method_states.append({})
    if options.memory_auto:
        others = [frame for frame in frames if frame.name not in scene_map.names]
        scene_map = scene_map.take((yield from fewest_keyframes(after, others)))
        after.keyframes[-1] = scene_map.keyframes
    yield Stage(after, 0, len(scene_map.keyframes), scene_map)
