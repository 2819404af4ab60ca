"""What stays of a scene that was just learned: keyframes, their depths, the method's state."""

from collections.abc import Sequence
from dataclasses import replace

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.method_state import FinishedScene, MethodState
from evercal.continual.strategies import STRATEGIES
from evercal.datasets.frame import Frame
from evercal.features.views import ViewOptions
from evercal.geometry.camera import Camera
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.mapping.plane_sweep import keyframe_depths
from evercal.mapping.scene_maps import SceneMaps
from evercal.networks.buffer import EncodePlan, FeatureBuffer, encode_frames


def select_keyframes(
    maps: SceneMaps,
    frames: Sequence[Frame],
    statistics: FrameStatistics,
    capacity: int,
    refined: Camera | None,
) -> Keyframes | None:
    """The keyframes that a strategy keeps of a scene's training frames, with depths if it matches.

    Args:
        maps: whose strategy selects.
        frames: in recorded order.
        statistics: the same frames as selectors see them.
        capacity: N_b, how many at most.
        refined: the camera as training corrected it; replay takes it as given.
    """
    strategy = STRATEGIES[maps.strategy]
    if strategy.select is None:
        return None
    chosen = strategy.select(statistics, capacity)
    if refined is not None:
        frames = [replace(frame, camera=refined) for frame in frames]
    keyframes = store_keyframes([frames[i] for i in chosen], maps.short_side)
    if strategy.match_keyframes:
        depths = keyframe_depths(
            chosen,
            frames,
            maps.short_side,
            maps.encoder.stride,
            statistics.local_features,
            statistics.depths_m,
        )
        keyframes = replace(keyframes, inverse_depth=depths)
    return keyframes


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
