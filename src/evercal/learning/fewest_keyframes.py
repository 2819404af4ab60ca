"""`--memory auto`: the fewest keyframes that locate a recording's other frames well."""

from collections.abc import Sequence

import numpy as np

from evercal.geometry import SE3, pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.built_map import BuiltMap
from evercal.mapping.scene_map import MapContents
from evercal.mapping.selection import spread_poses
from evercal.progress import OnProgress
from evercal.recordings.frame import Frame
from evercal.typing import IntArray

MOST_SHARE = 0.3
"""Share of the frames that are keyframes at first."""
SHARES = (0.05, 0.07, 0.1, 0.14, 0.2, MOST_SHARE)
"""Shares of the frames that are tried, smallest first."""
PROBE_FRAMES = 60
"""Other frames that are located, spread over the recording."""
LEAST_LOCATED = 0.98
"""Share of the probes located by all keyframes that a subset must locate as well."""
MOST_M, MOST_DEG = 0.005, 0.5
"""Largest distance from the pose by all keyframes."""


def fewest_keyframes(
    contents: MapContents,
    built: BuiltMap,
    frames: Sequence[Frame],
    on_progress: OnProgress = lambda *_: None,
) -> IntArray:
    """Select the fewest keyframes of a new scene.

    `contents` holds the scenes learned before, and `frames` are the posed training frames in
    recorded order. Returns sorted indices; all keyframes if they locate no other frame.
    """
    others = [frame for frame in frames if frame.name not in set(built.keyframe_names)]
    poses = built.scene.keyframes.base_from_camera
    everything = np.arange(len(poses))
    spread = (
        np.linspace(0, len(others) - 1, min(PROBE_FRAMES, len(others)))
        .round()
        .astype(int)
    )
    localizer = Localizer(contents.empty().with_scene(built.scene))
    located = _located(localizer, [others[i] for i in spread])
    probes = [
        others[i] for i, pose in zip(spread, located, strict=True) if pose is not None
    ]
    reference = [pose for pose in located if pose is not None]
    unit = built.scene.frame.scale
    sizes = sorted({max(1, int(share * built.scene.train_frames)) for share in SHARES})
    for step, size in enumerate(size for size in sizes if size < len(poses)):
        on_progress("selecting keyframes", step + 1, len(sizes))
        selected = spread_poses(poses, size)
        poses_of_few = _located(localizer.only(0, selected), probes)
        good = [
            _close(*pair, unit) for pair in zip(poses_of_few, reference, strict=True)
        ]
        if good and sum(good) >= LEAST_LOCATED * len(probes):
            everything = selected
            break
    on_progress("selecting keyframes", len(sizes), len(sizes))
    return everything


def _located(localizer: Localizer, frames: Sequence[Frame]) -> list[SE3 | None]:
    return [
        localizer.localize(f.read_image(), f.camera).base_from_camera for f in frames
    ]


def _close(pose: SE3 | None, reference: SE3, unit: float) -> bool:
    if pose is None:
        return False
    metres, radians = pose_distance(pose, reference)
    return bool(metres < MOST_M * unit and radians < np.deg2rad(MOST_DEG))
