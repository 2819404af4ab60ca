"""`learn`: one more scene, as a generator of progress, checkpoints and the finished stage."""

import copy
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from evercal.continual.fewest_keyframes import AutoMemoryOptions, fewest_keyframes
from evercal.continual.finish_scene import (
    mapped_record,
    method_state_of,
    select_keyframes,
    sized,
)
from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.methods.mir import mir_views
from evercal.continual.methods.preconditioning import preconditioner
from evercal.continual.strategies import STRATEGIES, Strategy
from evercal.datasets.frame import Frame, Scene
from evercal.errors import InputError
from evercal.features.precision import autocast
from evercal.geometry.camera import Camera
from evercal.mapping.atlas import Cell, camera_clusters
from evercal.mapping.build import MapOptions, Mapping, SceneMap, map_steps, spread_frames
from evercal.mapping.keyframes import store_keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord, corrected_camera, prototypes
from evercal.mapping.store import Checkpoint, Resume
from evercal.networks.buffer import EncodePlan, FeatureBuffer, Rows, encode_frames
from evercal.networks.head import Head, HeadOptions, HeadOutput
from evercal.networks.trainer import FitOptions, HeadTrainer, Progress, Replay

CHECKPOINT_SECONDS = 10.0
WHITENING_ROWS = 20_000


@dataclass(frozen=True)
class StageOptions:
    """How one scene is learned."""

    head: HeadOptions = field(default_factory=HeadOptions)
    """Shape of a new head; a later stage keeps the head it finds."""
    fit: FitOptions = field(default_factory=FitOptions)
    """Training."""
    encode: EncodePlan = field(default_factory=EncodePlan)
    """Views of the new scene's frames."""
    replay_views_per_frame: int = 4
    """Views of every remembered frame."""
    memory_share: float = 0.10
    """N_b as a share of the scene's training frames."""
    memory_auto: bool = False
    """Keep the fewest keyframes with which other frames are located well; maps only."""
    memory_bytes: int | None = None
    """N_b as a size instead; frames are counted at the size of the first one."""
    fixed_centres_m: tuple[tuple[float, float, float], ...] = ()
    """Atlas coordinates of all centres, known in advance (HeadOptions.centres `fixed`)."""
    grid_scenes: int = 0
    """Scenes of the combined grid (`Atlas` layout `paper`), if they are known in advance; 0 gives
    each the next free place."""
    map: MapOptions = field(default_factory=MapOptions)
    """Building of the map, where the strategy builds one."""
    seed: int = 0
    """Random seed."""

    def capacity(self, frames: Sequence[Frame], short_side: int) -> int:
        """N_b in frames, at least 1, for a scene of these training frames."""
        if self.memory_bytes is None:
            return max(1, int(self.memory_share * len(frames) + 1e-9))
        one = store_keyframes(frames[:1], short_side).bytes
        return min(len(frames), max(1, self.memory_bytes // one))


@dataclass
class Encoding:
    """The encoder is at work."""

    done: int
    """Views encoded."""
    total: int
    """Views to encode."""


@dataclass
class Stage:
    """A finished stage."""

    maps: SceneMaps
    """What is known now; thresholds are not fitted yet."""
    iterations: int
    """Optimiser steps."""
    frames_kept: int
    """Frames of this scene that stay in memory."""
    scene_map: SceneMap | None = None
    """The map that was built, if the strategy builds one."""


Event = Encoding | Mapping | Progress | Checkpoint | Stage


def learn(
    maps: SceneMaps,
    scene: Scene,
    options: StageOptions,
    resume: Resume | None = None,
    earlier: Sequence[Scene] = (),
) -> Iterator[Event]:
    """Learns one more scene.

    Args:
        maps: what is known so far; not changed.
        scene: its training frames are learned, its test frames are not looked at.
        options: how.
        resume: where an interrupted run of the same call stood.
        earlier: all earlier scenes, only for strategies with `data: all`.

    Raises:
        InputError: a strategy with `data: all` and not all earlier scenes.

    Yields:
        `Encoding` and `Progress` as it goes, a `Checkpoint` every 10 seconds, a `Stage` at the end.
    """
    strategy = STRATEGIES[maps.strategy]
    if strategy.data == "all" and len(earlier) != len(maps.scenes):
        raise InputError(
            f"strategy {maps.strategy!r}: learns all scenes at once and needs the "
            f"{len(maps.scenes)} earlier ones again, got {len(earlier)}; give them, or take "
            "another strategy"
        )
    if not strategy.network:
        yield from _learn_map(maps, scene, options)
        return
    # Views are made at the size at which the localizer will see images.
    view = replace(options.encode.view, short_side=maps.short_side)
    options = replace(options, encode=replace(options.encode, view=view))
    after = maps.copy_for_training()
    teacher = copy.deepcopy(after.heads[-1]).eval() if after.heads else None
    positions = np.stack([_pose(frame).translation_m for frame in scene.train])
    cell = after.atlas(options.grid_scenes).place(positions)
    head, local = _head_for_stage(after, strategy, options, cell, positions)
    buffer = FeatureBuffer(local, cell.atlas_from_base, _correctable(scene.train))
    pacer = _Pacer()
    yield from _encoded(buffer, scene, options, maps, resume, pacer)
    buffers = [buffer]
    if strategy.data == "all":
        buffers += yield from _refill(maps, earlier, options)
    if head.options.whiten and (strategy.data == "all" or head.scenes == 1):
        head.whiten(_sample(buffers, options.seed))
    replay = None
    if strategy.penalty is not None and teacher is not None:
        replay = yield from _replay(maps, strategy, teacher, options)
    regularizer = _regularizer(strategy, head, maps)
    trainer = HeadTrainer(head, buffers, replay, options.fit, options.seed, regularizer)
    if resume is not None and resume.trainer:
        trainer.load(dict(resume.trainer))
    for progress in trainer.run():
        yield progress
        if pacer.due():
            yield Checkpoint({}, trainer.state())
    refined, *others = _refined_cameras(trainer, [scene, *earlier])
    for i, camera in enumerate(others):
        after.scenes[i] = replace(after.scenes[i], refined_camera=camera)
    stage = yield from _finish(after, scene, cell, buffer, options, refined)
    yield stage


def _encoded(
    buffer: FeatureBuffer,
    scene: Scene,
    options: StageOptions,
    maps: SceneMaps,
    resume: Resume | None,
    pacer: "_Pacer",
) -> Iterator[Event]:
    """Encodes the scene's frames into the buffer, those that an interrupted run left to do."""
    for rows in resume.rows if resume else ():
        buffer.restore(rows)
    plan, total = options.encode, len(scene.train) * options.encode.views_per_frame
    for done in encode_frames(buffer, scene.train, plan, maps.encoder, maps.descriptor):
        yield Encoding(done, total)
        if pacer.due():
            yield Checkpoint(buffer.take_new(), {})
    new = buffer.take_new()
    if new:
        yield Checkpoint(new, {})


def _refined_cameras(trainer: HeadTrainer, scenes: Sequence[Scene]) -> list[Camera | None]:
    """For each buffer of the trainer its scene's camera as corrected; None where it is trusted."""
    refined: list[Camera | None] = [None] * len(trainer.buffers)
    if trainer.options.intrinsics_rate > 0 and trainer.options.iterations > 0:
        for i, buffer in enumerate(trainer.buffers):
            if buffer.correctable:
                nominal = scenes[i].train[0].camera
                refined[i] = corrected_camera(nominal, trainer.correction[i].detach())
    return refined


def _correctable(frames: Sequence[Frame]) -> bool:
    """Whether one camera without known distortion took all frames."""
    return not frames[0].camera.distortion and all(f.camera == frames[0].camera for f in frames)


def _pose(frame: Frame):
    assert frame.base_from_camera is not None, "training frames are posed"
    return frame.base_from_camera


def _head_for_stage(
    after: SceneMaps,
    strategy: Strategy,
    options: StageOptions,
    cell: Cell,
    positions: np.ndarray,
) -> tuple[Head, int]:
    """The head to train, grown by this scene, put in its place; and the scene's index in it."""
    number = len(after.scenes)
    in_atlas = cell.atlas_from_base.apply(positions)
    if strategy.data == "all":
        head = _fresh_head(after, options.head, options.seed)
        for i in range(len(after.scenes)):
            old = after.heads[0]
            head.grow(old.centres[old.centre_scene == i], options.seed + i)
        after.heads = []
    elif strategy.heads == "per_scene" or not after.heads:
        head = _fresh_head(after, options.head, options.seed)
    else:
        head = after.heads.pop()
    local = head.scenes
    head.grow(_new_centres(head, options, in_atlas), options.seed + number)
    after.heads.append(head)
    return head, local


def _fresh_head(after: SceneMaps, shape: HeadOptions, seed: int) -> Head:
    torch.manual_seed(seed)
    return Head(after.encoder.width, after.descriptor.width, shape)


def _sample(buffers: Sequence[FeatureBuffer], seed: int) -> Tensor:
    """Feature rows of all buffers, enough for their covariance."""
    generator = torch.Generator().manual_seed(seed)
    drawn = [buffer.draw(WHITENING_ROWS // len(buffers), generator) for buffer in buffers]
    return torch.cat([rows.features for rows in drawn])


def _new_centres(head: Head, options: StageOptions, positions: np.ndarray) -> Tensor:
    """(k, 3) centres that the scene adds, from its camera positions (n, 3) in the atlas."""
    kind, count = head.options.centres, head.options.centres_per_scene
    if kind == "grow":
        return torch.from_numpy(camera_clusters(positions, count, options.seed)).float()
    if head.scenes > 0:
        return torch.zeros(0, 3)
    if kind == "fixed":
        return torch.tensor(options.fixed_centres_m).reshape(-1, 3)
    from itertools import islice

    from evercal.mapping.atlas import spiral

    return torch.tensor(np.stack(list(islice(spiral(), count)))).float()


def _refill(maps: SceneMaps, earlier: Sequence[Scene], options: StageOptions) -> Iterator[Event]:
    """Encodes all earlier scenes again (strategies with `data: all`)."""
    buffers = []
    for i, (scene, record) in enumerate(zip(earlier, maps.scenes, strict=True)):
        correctable = _correctable(scene.train)
        buffer = FeatureBuffer(i, record.cell.atlas_from_base, correctable)
        plan = options.encode
        for done in encode_frames(buffer, scene.train, plan, maps.encoder, maps.descriptor):
            yield Encoding(done, len(scene.train) * plan.views_per_frame)
        buffers.append(buffer)
    return buffers


def _replay(
    maps: SceneMaps, strategy: Strategy, teacher: Head, options: StageOptions
) -> Iterator[Event]:
    """Encodes what is remembered and binds the penalty to the frozen teacher."""
    buffers, references = [], []
    for i, (keyframes, record) in enumerate(zip(maps.keyframes, maps.scenes, strict=True)):
        if keyframes is None or not keyframes.images:
            continue
        buffer = FeatureBuffer(i, record.cell.atlas_from_base)
        plan = replace(options.encode, views_per_frame=options.replay_views_per_frame)
        frames = keyframes.frames()
        for done in encode_frames(buffer, frames, plan, maps.encoder, maps.descriptor):
            yield Encoding(done, len(frames) * plan.views_per_frame)
        state = maps.method_states[i]
        if "points" in state:
            buffer.stored = state["points"].float() + state["origin"]
        references.append(state.get("reference", torch.tensor(torch.nan)))
        buffers.append(buffer)
    cost = strategy.penalty
    assert cost is not None

    def penalty(student: HeadOutput, rows: Rows, progress: float) -> Tensor:
        with torch.no_grad(), autocast():
            before = teacher(rows.features.float(), rows.scene, rows.descriptor)
        return strategy.strength * cost(student, before, rows, progress)

    if not buffers:
        return None
    return Replay(
        buffers,
        penalty,
        strategy.penalty_per_scene,
        preconditioner(strategy.preconditioning),
        strategy.combine,
        torch.stack(references),
        mir_views if strategy.mir else None,
    )


def _regularizer(strategy: Strategy, head: Head, maps: SceneMaps) -> Callable[[], Tensor] | None:
    """What the weights cost, given the states of earlier scenes; None where they cost nothing."""
    cost = strategy.regularizer
    if cost is None or not maps.method_states:
        return None
    return lambda: strategy.strength * cost(head, maps.method_states)


def _finish(
    after: SceneMaps,
    scene: Scene,
    cell: Cell,
    buffer: FeatureBuffer,
    options: StageOptions,
    refined: Camera | None,
) -> Generator[Event, None, Stage]:
    frames = scene.train
    descriptors = prototypes(buffer.tensors["descriptors"][: len(frames)])
    camera = frames[0].camera
    record = SceneRecord(scene.name, camera, cell, descriptors, len(frames), refined)
    statistics = FrameStatistics(frames, after.heads[-1], lambda: buffer, options.seed)
    capacity = options.capacity(frames, after.short_side)
    keyframes, scene_map = yield from select_keyframes(
        after, frames, statistics, capacity, refined, options.map
    )
    after.scenes.append(mapped_record(record, scene_map))
    after.keyframes.append(keyframes)
    after.method_states.append(method_state_of(after, buffer))
    kept = len(keyframes) if keyframes else 0
    return Stage(after, options.fit.iterations, kept, scene_map)


def _learn_map(maps: SceneMaps, scene: Scene, options: StageOptions) -> Iterator[Event]:
    """Learns a scene by building its map; nothing is trained."""
    after, frames = maps.copy_for_training(), scene.train
    positions = np.stack([_pose(frame).translation_m for frame in frames])
    cell = after.atlas(options.grid_scenes).place(positions)
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


class _Pacer:
    """Says when a checkpoint is due."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def due(self) -> bool:
        now = time.monotonic()
        if now - self._last < CHECKPOINT_SECONDS:
            return False
        self._last = now
        return True
