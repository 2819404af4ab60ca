"""What is stored of a scene after its stage: keyframes and the method's state."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from evercal.continual.learning.stage import Stage, StageOptions
from evercal.continual.learning.stage_rows import keyframe_rows
from evercal.continual.methods.method import FinishedScene, Method
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.scenes import (
    LearnedScenes,
    SceneRecord,
    corrected_camera,
    correction_between,
    prototypes,
)
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.recordings.frame import Frame, Recording


def finished_stage(
    scenes: LearnedScenes,
    method: Method,
    frames: Sequence[Frame],
    rows: Callable[[], FeatureBuffer],
    options: StageOptions,
) -> Stage:
    """Select what is stored of the newest scene and add it to `scenes`, which has its record.

    `rows` returns the rows of its frames with the intrinsics of the training; the first views are
    not augmented.
    """
    newest = len(scenes.scenes) - 1
    head, local = scenes.head_for(newest)
    statistics = FrameStatistics(frames, head, rows, options.seed, newest)
    selected = method.select(statistics, options.memory.capacity(frames, scenes.short_side))
    keyframes = None
    if selected is not None:
        keyframes = _keyframes(scenes, [frames[i] for i in selected], options)
    scenes.keyframes.append(keyframes)

    def remembered() -> FeatureBuffer:
        assert keyframes is not None, "a method whose state is about keyframes selects some"
        return keyframe_rows(scenes, newest, keyframes, options)

    diffusion = options.fit.diffusion if head.options.condition == "descriptor" else 0.0
    finished = FinishedScene(head.eval(), local, rows, remembered, diffusion)
    scenes.method_states.append(method.after_scene(finished))
    return Stage(scenes, options.fit.iterations, len(keyframes) if keyframes else 0)


def _keyframes(scenes: LearnedScenes, frames: Sequence[Frame], options: StageOptions) -> Keyframes:
    # Replay uses the camera as training corrected it.
    refined = scenes.scenes[-1].refined_camera
    if refined is not None:
        frames = [replace(frame, camera=refined) for frame in frames]
    keyframes = store_keyframes(frames, scenes.short_side)
    return keyframes.take(options.memory.fitting(keyframes))


def trained_record(scene: Recording, cell: Cell, trainer: HeadTrainer, number: int) -> SceneRecord:
    """The record of a scene after training; its rows are in the trainer's buffer `number`."""
    buffer, options = trainer.buffers[number], trainer.options
    camera, refined = scene.train[0].camera, None
    if options.intrinsics_rate > 0 and options.iterations > 0 and buffer.correctable:
        refined = corrected_camera(camera, trainer.correction[number].detach())
    spread = prototypes(buffer.tensors["descriptors"][: len(scene.train)])
    return SceneRecord(scene.name, camera, cell, spread, len(scene.train), refined)


def correct_lens(rows: FeatureBuffer, record: SceneRecord) -> None:
    """Apply the intrinsics of the training to a scene's rows."""
    if record.refined_camera is not None:
        rows.correct_lens(correction_between(record.camera, record.refined_camera))
