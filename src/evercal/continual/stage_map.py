"""The map of a scene that is being learned, with as many keyframes as may be kept."""

from collections.abc import Generator, Sequence
from dataclasses import replace

import numpy as np

from evercal.continual.stage import StageOptions
from evercal.mapping.build import Mapping, SceneMap, map_steps, spread_frames
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.scene_maps import SceneMaps
from evercal.mapping.selection import spread_poses
from evercal.recordings.frame import Frame


def stage_map(
    maps: SceneMaps, frames: Sequence[Frame], options: StageOptions
) -> Generator[Mapping, None, SceneMap]:
    """Builds the map of a scene from keyframes spread over its poses.

    Args:
        maps: whose encoder and working size; not changed.
        frames: posed training frames in recorded order.
        options: of the stage; they say how many keyframes stay.

    Raises:
        InputError: as `map_steps`.

    Yields:
        What is being done, for progress bars.

    Returns:
        The map with the keyframes that stay.
    """
    short_side = min(options.map.size.patches, *frames[0].read_image().shape[:2])
    chosen = spread_frames(frames, options.capacity(frames, short_side))
    sized = replace(options.map, size=replace(options.map.size, cells=maps.short_side))
    scene_map = yield from map_steps(frames, maps.encoder, chosen, sized)
    if options.memory_bytes is None:
        return scene_map
    return scene_map.take(fitting(scene_map.keyframes, options.memory_bytes))


def fitting(keyframes: Keyframes, most_bytes: int) -> np.ndarray:
    """Which keyframes fit into so many bytes: spread over their poses, at least one."""
    everything, size = len(keyframes), keyframes.bytes
    if size <= most_bytes:
        return np.arange(everything)
    for count in range(min(everything - 1, everything * most_bytes // size + 1), 1, -1):
        chosen = spread_poses(keyframes.base_from_camera, count)
        if keyframes.take(chosen).bytes <= most_bytes:
            return chosen
    return np.arange(1)
