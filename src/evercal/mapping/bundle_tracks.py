"""The observations that bundle adjustment works with: a spread subset of the landmarks."""

import numpy as np

from evercal.mapping.bundle_equations import BundleTracks
from evercal.mapping.prepared_frames import PreparedFrames
from evercal.mapping.tracks import KeyframeTracks, Observations, TrackOptions, joined, observe

_WIDE_STEPS = ((2, 4), (1, 4), (0, 4))
_PROBES = 64


def bundle_tracks(
    recording: PreparedFrames, keyframes: list[KeyframeTracks], options: TrackOptions
) -> BundleTracks:
    """A spread subset of the landmarks, in all frames that see enough of their keyframe."""
    o = options
    most = max(30, min(o.landmarks_per_keyframe, o.bundle_landmarks // len(keyframes)))
    tied = _tied_frames(recording, keyframes, o)
    parts: list[Observations] = []
    host, pixels, inverse, start = [], [], [], 0
    for keyframe, frames in zip(keyframes, tied, strict=True):
        which = np.flatnonzero(keyframe.kept)
        if len(which) < most // 2:
            which = np.arange(len(keyframe.landmarks))
        if len(which) > most:
            which = which[np.linspace(0, len(which) - 1, most).astype(int)]
        if not len(which):
            continue
        number = np.full(len(keyframe.landmarks), -1)
        number[which] = start + np.arange(len(which))
        for j in frames:
            seen = observe(recording, keyframe, j, which, _WIDE_STEPS, o.wide_reach_px, o)
            parts.append(
                Observations(number[seen.landmark], seen.frame, seen.pixels, seen.whitening)
            )
        host.append(np.full(len(which), keyframe.frame))
        pixels.append(keyframe.landmarks.pixels[which])
        inverse.append(keyframe.landmarks.inverse_depth[which])
        start += len(which)
    seen = joined(parts)
    often = np.bincount(seen.landmark, minlength=start)[seen.landmark] >= 2
    return BundleTracks(
        np.concatenate(host),
        np.concatenate(pixels),
        np.concatenate(inverse),
        seen.landmark[often],
        seen.frame[often],
        seen.pixels[often],
        seen.whitening[often],
        recording.depth_scale,
    )


def _tied_frames(
    recording: PreparedFrames, keyframes: list[KeyframeTracks], options: TrackOptions
) -> list[list[int]]:
    """Frames in which each keyframe's landmarks are looked for."""
    shared = np.stack([_shared(recording, keyframe) for keyframe in keyframes])
    best = np.argsort(-shared, axis=0, kind="stable")[: options.frames_per_keyframe]
    tied = np.zeros(shared.shape, bool)
    np.put_along_axis(tied, best, True, axis=0)
    tied &= shared > options.min_shared
    return [
        sorted({*np.flatnonzero(row).tolist(), *keyframe.sources} - {keyframe.frame})
        for row, keyframe in zip(tied, keyframes, strict=True)
    ]


def _shared(recording: PreparedFrames, keyframe: KeyframeTracks) -> np.ndarray:
    """(n,) how much of a keyframe's view every frame sees from a similar direction, 0 to 1."""
    cells = recording.posed_cells(keyframe.frame)
    some = np.linspace(0, len(keyframe.cell_inverse_depth) - 1, _PROBES).astype(int)
    local = cells.rays()[some] / keyframe.cell_inverse_depth[some, None]
    points = cells.base_from_camera.apply(local)
    towards = points[None] - recording.translation_m[:, None]
    unit = towards / (np.linalg.norm(towards, axis=-1, keepdims=True) + 1e-9)
    within = np.einsum("nji,npj->npi", recording.rotation, towards)
    shared = np.zeros(len(recording))
    for i in range(len(recording)):
        camera, front = recording.cameras[i], within[i, :, 2] > 0
        at = camera.project(np.where(front[:, None], within[i], [0, 0, 1]))
        inside = front & (at > 0).all(1) & (at < [camera.width, camera.height]).all(1)
        like = ((unit[i] * unit[keyframe.frame]).sum(1) - 0.7).clip(0, 1) / 0.3
        shared[i] = np.where(inside, like, 0).mean()
    shared[keyframe.frame] = 0
    return shared
