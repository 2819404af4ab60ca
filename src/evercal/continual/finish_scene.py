"""What stays of a scene that was just learned: keyframes, their depths, the method's state."""

from collections.abc import Generator, Sequence
from dataclasses import replace

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.method_state import FinishedScene, MethodState
from evercal.continual.strategies import STRATEGIES
from evercal.datasets.frame import Frame
from evercal.features.views import ViewOptions
from evercal.geometry.camera import Camera
from evercal.mapping.build import MapOptions, Mapping, SceneMap, map_steps
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.networks.buffer import EncodePlan, FeatureBuffer, encode_frames


def select_keyframes(
    maps: SceneMaps,
    frames: Sequence[Frame],
    statistics: FrameStatistics,
    capacity: int,
    refined: Camera | None,
    mapping: MapOptions,
) -> Generator[Mapping, None, tuple[Keyframes | None, SceneMap | None]]:
    """The keyframes that a strategy keeps of a scene, and their map if it has one.

    Args:
        maps: whose strategy selects.
        frames: in recorded order.
        statistics: the same frames as selectors see them.
        capacity: N_b, how many at most.
        refined: the camera as training corrected it; replay takes it as given.
        mapping: how a map is built.
    """
    strategy = STRATEGIES[maps.strategy]
    if strategy.select is None:
        return None, None
    chosen = strategy.select(statistics, capacity)
    if strategy.build_map:
        scene_map = yield from map_steps(frames, maps.encoder, chosen, sized(mapping, maps))
        return scene_map.keyframes, scene_map
    if refined is not None:
        frames = [replace(frame, camera=refined) for frame in frames]
    return store_keyframes([frames[i] for i in chosen], maps.short_side), None


def sized(options: MapOptions, maps: SceneMaps) -> MapOptions:
    """The options at the working size of a store."""
    return replace(options, size=replace(options.size, cells=maps.short_side))


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


def method_state_of(maps: SceneMaps, buffer: FeatureBuffer) -> MethodState:
    """What the strategy keeps of the newest scene beside its keyframes, which are chosen already.

    Args:
        maps: with the scene's record and keyframes.
        buffer: rows of its training frames.
    """
    after_scene = STRATEGIES[maps.strategy].after_scene
    if after_scene is None:
        return {}

    def remembered() -> FeatureBuffer:
        keyframes = maps.keyframes[-1]
        assert keyframes is not None, "a method whose state is about keyframes selects some"
        found = FeatureBuffer(buffer.scene, buffer.atlas_from_base)
        return plain_rows(found, keyframes.frames(), maps)

    return after_scene(FinishedScene(maps.heads[-1].eval(), buffer, remembered, maps.method_states))


def plain_rows(buffer: FeatureBuffer, frames: Sequence[Frame], maps: SceneMaps) -> FeatureBuffer:
    """Encodes frames as they are into a buffer, and gives it back."""
    plan = EncodePlan(views_per_frame=1, view=ViewOptions(short_side=maps.short_side))
    for _ in encode_frames(buffer, frames, plan, maps.encoder, maps.descriptor):
        pass
    return buffer
