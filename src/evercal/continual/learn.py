"""`learn`: one more scene, as a generator of progress, checkpoints and the finished stage."""

import copy
from collections.abc import Iterator
from dataclasses import replace

import torch

from evercal.continual.fewest_keyframes import AutoMemoryOptions, fewest_keyframes
from evercal.continual.finish_scene import (
    Learned,
    finished_stage,
    mapped_record,
    sized,
    trained_record,
)
from evercal.continual.methods.method import StageStart
from evercal.continual.stage import Event, Stage, StageOptions
from evercal.continual.stage_head import head_for_scene, whiten
from evercal.continual.stage_rows import Pacer, encoded, remembered, scene_buffer, view_plan
from evercal.continual.strategies import Strategy
from evercal.datasets.frame import Scene, known_poses
from evercal.mapping.build import map_steps, spread_frames
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.mapping.store import Checkpoint, Resume
from evercal.networks.trainer import HeadTrainer


def learn(
    maps: SceneMaps,
    strategy: Strategy,
    scene: Scene,
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
    if strategy.method is None:
        yield from _learn_map(maps, scene, options)
        return
    method = strategy.method
    after, frames = maps.copy_for_training(), scene.train
    teacher = copy.deepcopy(after.heads[-1]).eval() if after.heads else None
    positions = known_poses(frames).translation_m
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
    trainer = HeadTrainer(head, [buffer], options.fit, options.seed, hooks)
    if resume is not None and resume.trainer:
        trainer.load(dict(resume.trainer))
    for progress in trainer.run():
        yield progress
        if pacer.due():
            yield Checkpoint({}, trainer.state())
    after.scenes.append(trained_record(scene, cell, trainer, 0))
    done = Learned(frames, lambda: buffer, hooks)
    yield (yield from finished_stage(after, strategy, done, options))


def _learn_map(maps: SceneMaps, scene: Scene, options: StageOptions) -> Iterator[Event]:
    """Learns a scene by building its map; nothing is trained."""
    after, frames = maps.copy_for_training(), scene.train
    cell = after.atlas(options.grid_scenes).place(known_poses(frames).translation_m)
    if options.memory_auto:
        options = replace(options, memory_share=AutoMemoryOptions().most, memory_bytes=None)
    chosen = spread_frames(frames, options.capacity(frames, options.map.size.patches))
    scene_map = yield from map_steps(frames, maps.encoder, chosen, sized(options.map, maps))
    nothing = torch.zeros(0, after.descriptor.width).half()
    record = SceneRecord(scene.name, frames[0].camera, cell, nothing, len(frames))
    after.scenes.append(mapped_record(record, scene_map))
    after.keyframes.append(scene_map.keyframes)
    after.method_states.append({})
    if options.memory_auto:
        kept = scene_map.keyframes.take((yield from fewest_keyframes(after, frames)))
        after.keyframes[-1], scene_map = kept, replace(scene_map, keyframes=kept)
    yield Stage(after, 0, len(scene_map.keyframes), scene_map)
