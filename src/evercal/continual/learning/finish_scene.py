"""What is stored of a scene after its stage: keyframes, map, the method's state."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from evercal.continual.learning.stage import Stage, StageOptions
from evercal.continual.learning.stage_rows import keyframe_rows
from evercal.continual.methods.method import FinishedScene, Method, MethodState
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import (
    LearnedScenes,
    SceneRecord,
    corrected_camera,
    correction_between,
    prototypes,
)
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.strategies import Strategy
from evercal.mapping.build import BuiltMap
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.recordings.frame import Frame, Recording

Result = TypeVar("Result")


@dataclass(frozen=True)
class Learned:
    """A scene after its training."""

    frames: Sequence[Frame]
    """Its training frames in recorded order."""
    rows: Callable[[], FeatureBuffer]
    """Their rows with the intrinsics of the training; the first views are not augmented."""
    hooks: TrainingHooks | None = None
    """Hooks of the training, if the method has some."""
    built: BuiltMap | None = None
    """Its map, with which the frames were adjusted, for strategies that build one."""


def finished_stage(
    scenes: LearnedScenes, method: Method, scene: Learned, options: StageOptions
) -> Stage:
    """Select what is stored of the newest scene and add it to `scenes`.

    Args:
        scenes: with the scene's record and head, without its keyframes and state.
        method: of the training.
        scene: the newest scene.
        options: of the stage.
    """
    if scene.built is not None:
        scenes.scenes[-1] = replace(scenes.scenes[-1], map=scene.built.scene)
    keyframes = _keyframes(scenes, method, scene, options)
    scenes.keyframes.append(keyframes)
    scenes.method_states.append(_state(scenes, method, scene, options))
    count = len(keyframes) if keyframes else 0
    return Stage(scenes, options.fit.iterations, count, scene.built)


def _keyframes(
    scenes: LearnedScenes, method: Method, scene: Learned, options: StageOptions
) -> Keyframes | None:
    """Keyframes of the map; without a map, the selection of the method."""
    if scene.built is not None:
        return scene.built.scene.keyframes
    newest = len(scenes.scenes) - 1
    head, _ = scenes.head_for(newest)
    statistics = FrameStatistics(scene.frames, head, scene.rows, options.seed, newest)
    capacity = options.memory.capacity(scene.frames, scenes.short_side)
    selected = method.select(statistics, capacity)
    if selected is None:
        return None
    frames, refined = scene.frames, scenes.scenes[-1].refined_camera
    if refined is not None:  # replay uses the camera as training corrected it
        frames = [replace(frame, camera=refined) for frame in frames]
    keyframes = store_keyframes([frames[i] for i in selected], scenes.short_side)
    return keyframes.take(options.memory.fitting(keyframes))


def _state(
    scenes: LearnedScenes, method: Method, scene: Learned, options: StageOptions
) -> MethodState:
    """State of the method for the newest scene."""
    head, local = scenes.head_for(len(scenes.scenes) - 1)
    keyframes = scenes.keyframes[-1]

    def remembered() -> FeatureBuffer:
        assert keyframes is not None, "a method whose state is about keyframes selects some"
        return _returned(keyframe_rows(scenes, len(scenes.scenes) - 1, keyframes, options))

    count = len(keyframes) if keyframes else 0
    return method.after_scene(
        FinishedScene(
            head.eval(),
            local,
            scene.rows,
            remembered,
            count,
            scenes.method_states,
            scene.hooks,
            options.fit.diffusion if head.options.condition == "descriptor" else 0.0,
        )
    )


def memory_bytes(scenes: LearnedScenes, strategy: Strategy) -> int:
    """Size of what later stages use: keyframes and the method states that are needed."""
    if strategy.method is None:
        return scenes.memory_bytes
    needed = list(strategy.method.needed(scenes.method_states))
    return replace(scenes, method_states=needed).memory_bytes


def trained_record(
    scene: Recording, cell: Cell, trainer: HeadTrainer, number: int, frames: int
) -> SceneRecord:
    """The record of a scene after training, without its map.

    Args:
        scene: with its training frames as they are stated.
        cell: its cell of the atlas.
        trainer: of the training.
        number: which of the trainer's buffers holds the scene's rows.
        frames: number of its frames; their first views are not augmented.
    """
    buffer, options = trainer.buffers[number], trainer.options
    camera, refined = scene.train[0].camera, None
    if options.intrinsics_rate > 0 and options.iterations > 0 and buffer.correctable:
        refined = corrected_camera(camera, trainer.correction[number].detach())
    spread = prototypes(buffer.tensors["descriptors"][:frames])
    return SceneRecord(scene.name, camera, cell, spread, len(scene.train), refined)


def correct_lens(rows: FeatureBuffer, record: SceneRecord) -> None:
    """Apply the intrinsics of the training to a scene's rows."""
    if record.refined_camera is not None:
        rows.correct_lens(correction_between(record.camera, record.refined_camera))


def _returned(steps: Generator[object, None, Result]) -> Result:
    """The return value of a generator; what it yields is ignored."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value
