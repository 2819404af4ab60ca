"""Tracks for bundle adjustment: landmarks of all keyframes in the frames that show them."""

import numpy as np

from evercal.mapping.bundle_equations import BundleTracks
from evercal.mapping.covisibility import shared_view
from evercal.mapping.prepared_frames import PreparedFrames
from evercal.mapping.tracks import (
    WIDE_STEPS,
    KeyframeTracks,
    Observations,
    joined,
    observe,
)
from evercal.typing import Array, IntArray

WIDE_REACH_PX = 25.0
"""Largest distance of an observation from its prediction while poses are adjusted, pixels."""
FRAMES_PER_KEYFRAME = 3
"""Keyframes that each frame is tied to in bundle adjustment."""
LANDMARKS_PER_KEYFRAME = 200
"""Landmarks of a keyframe in bundle adjustment, at most."""
BUNDLE_LANDMARKS = 6000
"""Landmarks of all keyframes in bundle adjustment, at most."""
MIN_SHARED_VIEW = 0.15
"""Share of a keyframe's view that a frame tied to it must show."""


def bundle_tracks(
    recording: PreparedFrames, keyframes: list[KeyframeTracks]
) -> BundleTracks:
    """Observe a spread subset of the landmarks in all frames that show enough of their keyframe."""
    most = max(30, min(LANDMARKS_PER_KEYFRAME, BUNDLE_LANDMARKS // len(keyframes)))
    tied = _tied_frames(recording, keyframes)
    parts: list[Observations] = []
    host = []
    pixels = []
    inverse = []
    start = 0
    for keyframe, frames in zip(keyframes, tied, strict=True):
        which = _bundled(keyframe, most)
        if not len(which):
            continue
        number = np.full(len(keyframe.landmarks), -1)
        number[which] = start + np.arange(len(which))
        for j in frames:
            observed = observe(
                recording,
                keyframe,
                j,
                which,
                WIDE_STEPS,
                WIDE_REACH_PX,
            )
            parts.append(observed._replace(landmark=number[observed.landmark]))
        host.append(np.full(len(which), keyframe.frame))
        pixels.append(keyframe.landmarks.pixels[which])
        inverse.append(keyframe.landmarks.inverse_depth[which])
        start += len(which)
    observed = joined(parts)
    often = np.bincount(observed.landmark, minlength=start)[observed.landmark] >= 2
    return BundleTracks(
        host=np.concatenate(host),
        pixels=np.concatenate(pixels),
        inverse_depth=np.concatenate(inverse),
        landmark=observed.landmark[often],
        frame=observed.frame[often],
        observed=observed.pixels[often],
        whitening=observed.whitening[often],
        depth_scale=recording.depth_scale,
    )


def _bundled(keyframe: KeyframeTracks, most: int) -> IntArray:
    which = np.flatnonzero(keyframe.confirmed)
    if len(which) < most // 2:
        which = np.arange(len(keyframe.landmarks))
    if len(which) > most:
        which = which[np.linspace(0, len(which) - 1, most).astype(int)]
    return which


def _tied_frames(
    recording: PreparedFrames, keyframes: list[KeyframeTracks]
) -> list[list[int]]:
    shared = np.stack([_shared_view(recording, keyframe) for keyframe in keyframes])
    best = np.argsort(-shared, axis=0, kind="stable")[:FRAMES_PER_KEYFRAME]
    tied = np.zeros(shared.shape, bool)
    np.put_along_axis(tied, best, True, axis=0)
    tied &= shared > MIN_SHARED_VIEW
    return [
        sorted({*np.flatnonzero(row).tolist(), *keyframe.sources} - {keyframe.frame})
        for row, keyframe in zip(tied, keyframes, strict=True)
    ]


def _shared_view(recording: PreparedFrames, keyframe: KeyframeTracks) -> Array:
    """(n,) see `shared_view`; 0 for the keyframe itself."""
    shared = shared_view(
        1 / keyframe.cell_inverse_depth,
        recording.posed_cells(keyframe.frame),
        recording.poses,
        recording.cameras,
    )
    shared[keyframe.frame] = 0
    return shared
