"""What stays of a scene that was just learned: keyframes, their map, the method's state."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.methods.method import FinishedScene, Method, MethodState
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.hooks import TrainingHooks
from evercal.continual.networks.trainer import HeadTrainer
from evercal.continual.stage import Stage, StageOptions
from evercal.continual.stage_map import fitting
from evercal.continual.stage_rows import keyframe_rows
from evercal.continual.strategies import Strategy
from evercal.mapping.build import SceneMap, finished
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.mapping.scene_maps import (
    SceneMaps,
    SceneRecord,
    corrected_camera,
    correction_between,
    prototypes,
)
from evercal.recordings.frame import Frame, Recording


@dataclass(frozen=True)
class Learned:
    """A scene that was just learned."""

    frames: Sequence[Frame]
    """Its training frames in recorded order."""
    rows: Callable[[], FeatureBuffer]
    """Their rows, of the lens that training found; the first views are the frames as they are."""
    hooks: TrainingHooks | None = None
    """Those of the training; None where it was plain."""
    scene_map: SceneMap | None = None
    """Its map, from which the frames are; None where none is built."""


def finished_stage(maps: SceneMaps, method: Method, scene: Learned, options: StageOptions) -> Stage:
    """Chooses what stays of the newest scene and adds it to `maps`.

    Args:
        maps: with the scene's record and head, without its keyframes and state.
        method: by which the head was trained.
        scene: what was learned.
        options: of the stage.
    """
    maps.scenes[-1] = mapped_record(maps.scenes[-1], scene.scene_map)
    keyframes = _keyframes(maps, method, scene, options)
    maps.keyframes.append(keyframes)
    maps.method_states.append(_state(maps, method, scene, options))
    kept = len(keyframes) if keyframes else 0
    return Stage(maps, options.fit.iterations, kept, scene.scene_map)


def _keyframes(
    maps: SceneMaps, method: Method, scene: Learned, options: StageOptions
) -> Keyframes | None:
    """Those of the map; where there is none, those that the method selects."""
    if scene.scene_map is not None:
        return scene.scene_map.keyframes
    head, _ = maps.head_for(len(maps.scenes) - 1)
    statistics = FrameStatistics(scene.frames, head, scene.rows, options.seed)
    chosen = method.select(statistics, options.capacity(scene.frames, maps.short_side))
    if chosen is None:
        return None
    frames, refined = scene.frames, maps.scenes[-1].refined_camera
    if refined is not None:  # replay takes the camera as training corrected it
        frames = [replace(frame, camera=refined) for frame in frames]
    kept = store_keyframes([frames[i] for i in chosen], maps.short_side)
    if options.memory_bytes is None:
        return kept
    return kept.take(fitting(kept, options.memory_bytes))


def _state(maps: SceneMaps, method: Method, scene: Learned, options: StageOptions) -> MethodState:
    """What the method keeps of the newest scene beside its keyframes."""
    head, local = maps.head_for(len(maps.scenes) - 1)
    keyframes = maps.keyframes[-1]

    def remembered() -> FeatureBuffer:
        assert keyframes is not None, "a method whose state is about keyframes selects some"
        return finished(keyframe_rows(maps, len(maps.scenes) - 1, keyframes, options))

    kept = len(keyframes) if keyframes else 0
    return method.after_scene(
        FinishedScene(
            head.eval(),
            local,
            scene.rows,
            remembered,
            kept,
            maps.method_states,
            scene.hooks,
            options.fit.diffusion if head.options.condition == "descriptor" else 0.0,
        )
    )


def memory_bytes(maps: SceneMaps, strategy: Strategy) -> int:
    """Size of all that later stages look at: keyframes and the method states that are needed."""
    if strategy.method is None:
        return maps.memory_bytes
    needed = list(strategy.method.needed(maps.method_states))
    return replace(maps, method_states=needed).memory_bytes


def trained_record(
    scene: Recording, cell: Cell, trainer: HeadTrainer, number: int, frames: int
) -> SceneRecord:
    """The record of a scene that was trained on, without its map.

    Args:
        scene: with its training frames as they are stated.
        cell: its place in the atlas.
        trainer: of the training.
        number: which of the trainer's buffers holds the scene's rows.
        frames: how many frames they show, each first as it is.
    """
    buffer, options = trainer.buffers[number], trainer.options
    camera, refined = scene.train[0].camera, None
    if options.intrinsics_rate > 0 and options.iterations > 0 and buffer.correctable:
        refined = corrected_camera(camera, trainer.correction[number].detach())
    seen = prototypes(buffer.tensors["descriptors"][:frames])
    return SceneRecord(scene.name, camera, cell, seen, len(scene.train), refined)


def correct_lens(rows: FeatureBuffer, record: SceneRecord) -> None:
    """Has a scene's rows say what the lens says that training found, if it found one."""
    if record.refined_camera is not None:
        rows.correct_lens(correction_between(record.camera, record.refined_camera))


def mapped_record(record: SceneRecord, scene_map: SceneMap | None) -> SceneRecord:
    """A scene's record with what its map adjusted."""
    if scene_map is None:
        return record
    return replace(
        record,
        refined_camera=scene_map.camera,
        common=scene_map.common,
        map_sigma=scene_map.pose_sigma,
        bend=scene_map.bend,
        frame_covariance=scene_map.frame_covariance,
    )
