"""`learn`: one more scene, as a generator of progress, checkpoints and the finished stage."""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from evercal.continual.learning.finish_scene import (
    Learned,
    correct_lens,
    finished_stage,
    trained_record,
)
from evercal.continual.learning.stage import Event, Stage, StageOptions
from evercal.continual.learning.stage_head import head_for_scene, whiten
from evercal.continual.learning.stage_rows import (
    Pacer,
    add_surfaces,
    encoded,
    remembered,
    scene_buffer,
    view_plan,
)
from evercal.continual.methods.method import StageStart
from evercal.continual.networks.distributed import broadcast
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.continual.store import Checkpoint, Resume
from evercal.continual.strategies import Strategy
from evercal.mapping.build import BuiltMap, OnProgress, build_map
from evercal.recordings.frame import Frame, Recording, stated_poses


def learn(
    scenes: LearnedScenes,
    strategy: Strategy,
    recording: Recording,
    options: StageOptions,
    resume: Resume | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> Iterator[Event]:
    """Learn one more scene.

    Args:
        scenes: what was learned before; not changed.
        strategy: a method, a map or both; a joint strategy has its own function, `learn_jointly`.
        recording: its training frames are learned, its test frames are not read.
        options: of the stage.
        resume: checkpoints of an interrupted run of the same call.
        on_progress: called while a map is built.

    Yields:
        `Encoding` and `Progress`, a `Checkpoint` every 10 seconds, and a `Stage` at the end.
    """
    method = strategy.method
    if method is None:
        yield _learn_map(scenes, recording, options, on_progress)
        return
    after, frames, built = scenes.copy_for_training(), recording.train, None
    if strategy.builds_map:
        built = build_scene_map(scenes, recording, options, on_progress)
        frames = adjusted_frames(built, frames)
    teacher = copy.deepcopy(after.heads[-1]).eval() if after.heads else None
    positions = stated_poses(frames).translation_m
    cell = after.atlas(options.grid_scenes).place(positions)
    in_atlas = cell.atlas_from_base.apply(positions)
    head, local = head_for_scene(after, method.head_per_scene, options, in_atlas)
    buffer, pacer = scene_buffer(local, cell, frames, scenes.device), Pacer()
    plan = view_plan(options, scenes.short_side)
    yield from encoded(buffer, frames, plan, scenes, resume, pacer)
    if options.fit.surface_weight > 0:
        yield from add_surfaces(buffer, frames, scenes)
    if teacher is None:
        whiten(head, [buffer], options.seed)
    memories = (yield from remembered(scenes, options)) if method.replays else []
    rows, states = options.fit.replay_batch, scenes.method_states
    # Hooks may derive values from the weights, which must be equal in all processes.
    broadcast([*head.parameters(), *head.buffers()])
    hooks = method.begin(StageStart(head, teacher, memories, states, rows, options.seed))
    fit = options.fit if built is None else options.fit.with_known_lens()
    trainer = HeadTrainer(head, [buffer], fit, options.seed, hooks)
    if resume is not None and resume.trainer:
        trainer.load(dict(resume.trainer))
    for progress in trainer.run():
        yield progress
        if pacer.due():
            yield Checkpoint({}, trainer.state())
    after.scenes.append(trained_record(recording, cell, trainer, 0, len(frames)))
    correct_lens(buffer, after.scenes[-1])
    done = Learned(frames, lambda: buffer, hooks, built)
    yield finished_stage(after, method, done, options)


def build_scene_map(
    scenes: LearnedScenes, recording: Recording, options: StageOptions, on_progress: OnProgress
) -> BuiltMap:
    """Build the map of a scene with a stage's options."""
    sized = options.map_options(scenes.short_side)
    return build_map(recording.name, recording.train, scenes.encoder, sized, on_progress)


def adjusted_frames(built: BuiltMap, frames: Sequence[Frame]) -> list[Frame]:
    """Frames with the poses and intrinsics of their map, so that a network learns the same points.

    Frames that the map excludes are left out.

    Args:
        built: the map of the recording.
        frames: the posed frames that it was built from, in recorded order.
    """
    scene, adjusted = built.scene, []
    for frame in frames:
        excluded = (*built.adjusted.wrong_poses, *built.adjusted.untracked)
        if frame.name in excluded or frame.base_from_camera is None:
            continue
        camera = scene.adjusted_camera if frame.camera == scene.camera else frame.camera
        pose = scene.frame.from_base(frame.base_from_camera)
        adjusted.append(replace(frame, base_from_camera=pose, camera=camera))
    return adjusted


def _learn_map(
    scenes: LearnedScenes, recording: Recording, options: StageOptions, on_progress: OnProgress
) -> Stage:
    """Learn a scene by building its map; nothing is trained."""
    after, frames = scenes.copy_for_training(), recording.train
    built = build_scene_map(scenes, recording, options, on_progress)
    cell = after.atlas(options.grid_scenes).place(stated_poses(frames).translation_m)
    empty = torch.zeros(0, after.descriptor.width).half()
    after.scenes.append(
        SceneRecord(recording.name, frames[0].camera, cell, empty, len(frames), map=built.scene)
    )
    after.keyframes.append(built.scene.keyframes)
    after.method_states.append({})
    return Stage(after, 0, len(built.scene.keyframes), built)
