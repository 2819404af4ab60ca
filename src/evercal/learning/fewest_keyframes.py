"""`--memory auto`: the fewest keyframes that locate a recording's other frames well."""

from collections.abc import Sequence

import numpy as np

from evercal.geometry import SE3, pose_distance
from evercal.learning.stated_scatter import localizer_of, located_poses
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
"""Maximum number of other frames that are located, spread over the recording."""
LEAST_LOCATED = 0.98
"""Least share of the probes located by all keyframes that a subset locates as well."""
MOST_M = 0.005
"""Largest distance from the position by all keyframes, metres."""
MOST_DEG = 0.5
"""Largest angle to the rotation by all keyframes, degrees."""


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
    names = set(built.keyframe_names)
    others = [frame for frame in frames if frame.name not in names]
    keyframes = built.scene.keyframes.base_from_camera
    count = min(PROBE_FRAMES, len(others))
    spread = np.linspace(0, len(others) - 1, count).round().astype(int)
    localizer = localizer_of(contents, built.scene)
    probes = []
    references = []
    candidates = [others[i] for i in spread]
    located = located_poses(localizer, candidates)
    for frame, pose in zip(candidates, located, strict=True):
        if pose:
            probes.append(frame)
            references.append(pose)
    unit = built.scene.frame.scale
    sizes = sorted({max(1, int(share * built.scene.train_frames)) for share in SHARES})
    fewest = np.arange(len(keyframes))
    for step, size in enumerate(sizes):
        if size >= len(keyframes):
            break
        on_progress("selecting keyframes", step + 1, len(sizes))
        selected = spread_poses(keyframes, size)
        poses = located_poses(localizer.only(0, selected), probes)
        close = 0
        for pose, reference in zip(poses, references, strict=True):
            close += _close(pose, reference, unit)
        if probes and close >= LEAST_LOCATED * len(probes):
            fewest = selected
            break
    on_progress("selecting keyframes", len(sizes), len(sizes))
    return fewest


def _close(pose: SE3 | None, reference: SE3, unit: float) -> bool:
    if not pose:
        return False
    metres, radians = pose_distance(pose, reference)
    return bool(metres < MOST_M * unit and radians < np.deg2rad(MOST_DEG))
