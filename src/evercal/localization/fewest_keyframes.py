"""`--memory auto`: the fewest keyframes with which a recording's other frames are located well."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evercal.geometry.se3 import SE3, pose_distance
from evercal.localization.acceptance import MAX_SUPPORT
from evercal.localization.localizer import Localizer
from evercal.mapping.build import Mapping
from evercal.mapping.scene_maps import SceneMaps
from evercal.mapping.selection import spread_poses
from evercal.recordings.frame import Frame


@dataclass(frozen=True)
class AutoMemoryOptions:
    """How many keyframes a scene gets."""

    most: float = 0.3
    """Share of the frames that are keyframes at first, of which the fewest are kept."""
    shares: tuple[float, ...] = (0.05, 0.07, 0.1, 0.14, 0.2, 0.3)
    """Shares of the frames that are tried, fewest first."""
    probes: int = 60
    """Other frames that must be located, spread over the recording."""
    least_located: float = 0.98
    """Share of those that all keyframes locate which fewer must locate as well."""
    most_m: float = 0.005
    """Largest distance from where all keyframes locate a frame, metres."""
    most_deg: float = 0.5
    """The same for the rotation, degrees."""


def fewest_keyframes(
    maps: SceneMaps, others: Sequence[Frame], options: AutoMemoryOptions | None = None
) -> Generator[Mapping, None, NDArray[np.int64]]:
    """Which keyframes of the newest scene are kept.

    Args:
        maps: with the scene's record and all of its keyframes.
        others: posed training frames of the scene that are no keyframes, in recorded order.
        options: how many.

    Yields:
        What is being done, for progress bars.

    Returns:
        Their numbers, sorted.
    """
    options = options or AutoMemoryOptions()
    whole = maps.keyframes[-1]
    assert whole is not None, "a scene with a map has keyframes"
    everything = np.arange(len(whole))
    spread = np.linspace(0, len(others) - 1, min(options.probes, len(others))).round().astype(int)
    probes = [others[i] for i in spread]
    truth = _located(maps, everything, probes)
    seen = [i for i, pose in enumerate(truth) if pose is not None]
    sizes = sorted({max(1, int(share * maps.scenes[-1].train_frames)) for share in options.shares})
    for step, size in enumerate(size for size in sizes if size < len(whole)):
        yield Mapping("choosing keyframes", step + 1, len(sizes))
        chosen = spread_poses(whole.base_from_camera, size)
        found = _located(maps, chosen, [probes[i] for i in seen])
        good = [_close(a, truth[i], options) for a, i in zip(found, seen, strict=True)]
        if sum(good) >= options.least_located * len(seen):
            yield Mapping("choosing keyframes", len(sizes), len(sizes))
            return chosen
    yield Mapping("choosing keyframes", len(sizes), len(sizes))
    return everything


def _located(
    maps: SceneMaps, chosen: NDArray[np.int64], probes: Sequence[Frame]
) -> list[SE3 | None]:
    """Where the scene's chosen keyframes alone locate frames."""
    whole = maps.keyframes[-1]
    assert whole is not None, "a scene with a map has keyframes"
    record = replace(maps.scenes[-1], min_support=MAX_SUPPORT)
    alone = SceneMaps(maps.encoder, maps.descriptor, maps.strategy, maps.short_side)
    alone.scenes, alone.keyframes = [record], [whole.take(chosen)]
    alone.method_states = [{}]
    localizer = Localizer(alone)
    return [localizer.localize(f.read_image(), f.camera).base_from_camera for f in probes]


def _close(found: SE3 | None, truth: SE3 | None, options: AutoMemoryOptions) -> bool:
    if found is None or truth is None:
        return False
    metres, radians = pose_distance(found, truth)
    return bool(metres < options.most_m and radians < np.deg2rad(options.most_deg))
