"""Tracks: where landmarks of keyframes are seen in other frames, by patch alignment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evercal.mapping.landmarks import Landmarks, detect, project_surface, slopes
from evercal.mapping.patches import Patches, align_down, cut_patches, to_level, whitening
from evercal.mapping.plane_sweep import (
    FAR_M,
    NEAR_M,
    USUAL_M,
    inverse_depths,
    select_source_views,
)
from evercal.mapping.prepared_frames import PYRAMID_LEVELS, PreparedFrames

Array = NDArray[np.floating]


@dataclass(frozen=True)
class TrackOptions:
    """How landmarks are found in other frames."""

    source_views: int = 12
    """Frames that tell the depths of a keyframe, at most."""
    min_correlation: float = 0.8
    """Smallest normalised cross-correlation of an observation."""
    reach_px: float = 12.0
    """An observation lies at most this far from where it was expected."""
    wide_reach_px: float = 25.0
    """The same while poses are adjusted."""
    frames_per_keyframe: int = 3
    """Every frame is tied to this many keyframes that see the same, in bundle adjustment."""
    landmarks_per_keyframe: int = 200
    """Landmarks of a keyframe that take part in bundle adjustment, at most."""
    bundle_landmarks: int = 6000
    """Landmarks in bundle adjustment over all keyframes, at most."""
    min_shared: float = 0.15
    """Smallest share of a keyframe's view that a frame tied to it must see."""
    floor_px: float = 0.1
    """Alignment error of a perfect patch where `noise` is 1, pixels: with 0.8, 0.08 px at level 0.
    """
    noise: float = 0.8
    """Standard deviation of intensities in aligned patches, in deviations of a patch."""
    min_views: int = 3
    """A landmark is kept when at least this many frames agree on it."""
    max_residual_px: float = 0.85
    """And when the root mean square residual per axis is below this."""
    slant: bool = True
    """Warp patches by the slant of their surface; else they are parallel to the keyframe."""


@dataclass(eq=False)
class KeyframeTracks:
    """A keyframe while its map is built."""

    frame: int
    """Its number in the recording."""
    landmarks: Landmarks
    """As refined so far."""
    cell_inverse_depth: np.ndarray
    """(cells,) inverse depth of every cell, per metre."""
    patches: tuple[Patches, ...]
    """Templates of the landmarks in every pyramid level."""
    sources: tuple[int, ...]
    """Frames that see the same under parallax."""
    kept: NDArray[np.bool_]
    """(n,) landmarks that enough frames agree on."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Landmarks of one keyframe seen in other frames."""

    landmark: NDArray[np.int64]
    """(m,)."""
    frame: NDArray[np.int64]
    """(m,)."""
    pixels: Array
    """(m, 2)."""
    whitening: Array
    """(m, 2, 2) see `patches.whitening`."""


def open_keyframe(recording: PreparedFrames, frame: int, options: TrackOptions) -> KeyframeTracks:
    """Landmarks of a keyframe with depths from a plane sweep over other frames."""
    view, poses = recording.posed_cells(frame), recording.poses
    cameras = [recording.cell_camera(i) for i in range(len(recording))]
    scale = recording.depth_scale
    guess = np.full(len(view.features), scale * USUAL_M)
    near = select_source_views(guess, view, poses, cameras, options.source_views)
    others = [recording.posed_cells(i) for i in near]
    swept = inverse_depths(view, others, guess, guess_weight=0.0, scale=scale)
    inverse = swept.double().numpy()
    near = select_source_views(1 / inverse, view, poses, cameras, options.source_views)
    cell_px = recording.cell_px(frame)
    pixels, cells = detect(recording.grey[frame], view.grid, cell_px)
    there = np.isfinite(recording.cameras[frame].unproject(pixels)).all(1)
    pixels, cells = pixels[there], cells[there]
    slant = slopes(inverse, view.grid, cell_px) * options.slant
    marks = Landmarks(pixels, inverse[cells], slant[cells], np.ones(len(cells)))
    pyramid = recording.pyramid(frame)
    patches = tuple(
        cut_patches(pyramid[level], to_level(pixels, level)) for level in range(PYRAMID_LEVELS)
    )
    kept = np.zeros(len(cells), bool)
    return KeyframeTracks(frame, marks, inverse, patches, tuple(near), kept)


def observe(
    recording: PreparedFrames,
    keyframe: KeyframeTracks,
    frame: int,
    which: NDArray[np.int64],
    steps: Sequence[tuple[int, int]],
    reach_px: float,
    options: TrackOptions,
) -> Observations:
    """Finds landmarks of a keyframe in another frame.

    Args:
        recording: the frames.
        keyframe: whose landmarks are looked for.
        frame: the other frame.
        which: (n,) landmarks to look for.
        steps: pyramid levels and iterations, see `align_down`.
        reach_px: how far from the expected place an observation may lie.
        options: how.
    """
    surface = keyframe.landmarks.take(which).surface(recording.cameras[keyframe.frame])
    turn, shift = recording.relative(frame, keyframe.frame)
    visible, expected, affines = project_surface(surface, turn, shift, recording.cameras[frame])
    which = which[visible]
    templates = tuple(level.take(which) for level in keyframe.patches)
    pixels, correlation = align_down(templates, recording.pyramid(frame), expected, affines, steps)
    good = correlation > options.min_correlation
    good &= np.linalg.norm(pixels - expected, axis=1) < reach_px
    last = steps[-1][0]
    spread = templates[last].inverse_hessian[good]
    white = whitening(affines[good], spread, options.floor_px, options.noise) / 2**last
    return Observations(which[good], np.full(good.sum(), frame), pixels[good], white)


_DEPTH_ROUNDS = ((((1, 6),), 1), (((1, 3), (0, 5)), 2), (((0, 4),), 2))
"""(levels and iterations of alignment, Gauss-Newton steps) of each round."""


def refine_depths(
    recording: PreparedFrames, keyframe: KeyframeTracks, options: TrackOptions, again: bool = False
) -> None:
    """Gauss-Newton on the inverse depths of a keyframe's landmarks; poses stay.

    Args:
        recording: the frames.
        keyframe: whose landmarks are refined.
        options: how.
        again: depths are nearly right already, so the coarse round is left out.
    """
    if not keyframe.sources or not len(keyframe.landmarks):
        return
    seen, which = None, np.arange(len(keyframe.landmarks))
    for steps, updates in _DEPTH_ROUNDS[again:]:
        found = [
            observe(recording, keyframe, j, which, steps, options.reach_px, options)
            for j in keyframe.sources
        ]
        seen = joined(found)
        # What hardly any frame sees now will not be seen by enough of them later.
        count = np.bincount(seen.landmark, minlength=len(keyframe.landmarks))
        which = np.flatnonzero(count >= options.min_views - 1)
        for _ in range(updates):
            _depth_step(recording, keyframe, seen)
    assert seen is not None
    _judge(recording, keyframe, seen, options)


def joined(parts: Sequence[Observations]) -> Observations:
    """Several sets of observations as one."""
    return Observations(
        np.concatenate([part.landmark for part in parts]),
        np.concatenate([part.frame for part in parts]),
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.whitening for part in parts]),
    )


_FAR_OFF_PX = 1e3
"""Residual of what lies where a lens no longer holds."""


def _residuals(
    recording: PreparedFrames, keyframe: KeyframeTracks, seen: Observations
) -> tuple[Array, Array]:
    """Residuals (m, 2) in pixels and their derivatives (m, 2) by the inverse depth."""
    rays = recording.cameras[keyframe.frame].unproject(keyframe.landmarks.pixels)
    rho = keyframe.landmarks.inverse_depth
    residual, slope = np.zeros((len(seen.frame), 2)), np.zeros((len(seen.frame), 2))
    for j in keyframe.sources:
        here = seen.frame == j
        which, camera = seen.landmark[here], recording.cameras[j]
        turn, shift = recording.relative(j, keyframe.frame)
        ray, step = rays[which] @ turn.T, 1e-4 * rho[which, None]
        at = camera.project(_ahead(ray + rho[which, None] * shift))
        beside = camera.project(_ahead(ray + (rho[which, None] + step) * shift))
        known = np.isfinite(at + beside).all(1, keepdims=True)
        residual[here] = np.where(known, seen.pixels[here] - at, _FAR_OFF_PX)
        slope[here] = np.where(known, (beside - at) / step, 0)
    return residual, slope


def _ahead(points: Array) -> Array:
    return np.concatenate([points[:, :2], np.maximum(points[:, 2:], 1e-3)], 1)


def _weighted(
    recording: PreparedFrames, keyframe: KeyframeTracks, seen: Observations
) -> tuple[Array, Array, Array, Array]:
    """Residuals (m, 2) in pixels, whitened residuals and slopes (m, 2), robust weights (m,)."""
    raw, slope = _residuals(recording, keyframe, seen)
    residual = np.einsum("nij,nj->ni", seen.whitening, raw)
    slope = np.einsum("nij,nj->ni", seen.whitening, slope)
    return raw, residual, slope, 1 / (1 + (residual**2).sum(1))


def _depth_step(recording: PreparedFrames, keyframe: KeyframeTracks, seen: Observations) -> None:
    marks, n = keyframe.landmarks, len(keyframe.landmarks)
    _, residual, slope, weight = _weighted(recording, keyframe, seen)
    pull = np.bincount(seen.landmark, weight * (slope * residual).sum(1), n)
    hold = np.bincount(seen.landmark, weight * (slope**2).sum(1), n) + 1e-9
    rho = marks.inverse_depth
    least, most = 0.6 / FAR_M, 1.25 / NEAR_M
    scale = recording.depth_scale
    rho = rho + (pull / hold).clip(-0.15 * rho, 0.15 * rho)
    rho = rho.clip(least / scale, most / scale)
    keyframe.landmarks = Landmarks(marks.pixels, rho, marks.slope, marks.sigma)


def _judge(
    recording: PreparedFrames, keyframe: KeyframeTracks, seen: Observations, options: TrackOptions
) -> None:
    """Which landmarks are kept, and the uncertainty of their inverse depths."""
    marks, n = keyframe.landmarks, len(keyframe.landmarks)
    raw, residual, slope, weight = _weighted(recording, keyframe, seen)
    squares = (residual**2).sum(1)
    near = squares < 16.0
    which = seen.landmark[near]
    count = np.bincount(which, minlength=n)
    mean = np.bincount(which, squares[near], n) / np.maximum(count, 1) / 2
    pixels = np.sqrt(np.bincount(which, (raw[near] ** 2).sum(1), n) / np.maximum(count, 1) / 2)
    information = np.bincount(which, (weight * (slope**2).sum(1))[near], n)
    sigma = np.sqrt(np.maximum(mean, 0.5) / np.maximum(information, 1e-9))
    keyframe.landmarks = Landmarks(marks.pixels, marks.inverse_depth, marks.slope, sigma)
    keyframe.kept = (count >= options.min_views) & (pixels < options.max_residual_px)
