"""Tracks: observations of landmarks in other frames, by patch alignment."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from evercal.geometry import norms
from evercal.mapping.keyframes import Keyframes, jpeg
from evercal.mapping.landmarks import Landmarks, detect, project_surface, slopes
from evercal.mapping.patches import (
    Patches,
    align_down,
    cut_patches,
    to_level,
    whitening,
)
from evercal.mapping.plane_sweep import FAR_M, NEAR_M
from evercal.mapping.prepared_frames import PreparedFrames
from evercal.processes import cores
from evercal.progress import OnProgress
from evercal.typing import Array, BoolArray, IntArray

Steps = Sequence[tuple[int, int]]
"""Pyramid levels and alignment iterations, see `align_down`."""


_DEPTH_ROUNDS: tuple[tuple[Steps, int], ...] = (
    (((1, 6),), 1),
    (((1, 3), (0, 5)), 2),
    (((0, 4),), 2),
)
"""Rounds of depth refinement: alignment, and the number of Gauss-Newton steps after it."""
WIDE_STEPS: Steps = ((2, 4), (1, 4), (0, 4))
_FAR_OFF_PX = 1e3
"""Residual of a landmark that the distortion of a camera has no pixel for."""
_OUTLIER_SQUARES = 16.0
"""Squared whitened residual above which an observation does not count."""
SWEPT_FRAMES = 12
"""Frames that the depths of a keyframe are swept over, at most."""
MIN_CORRELATION = 0.8
"""Smallest normalised cross-correlation of an observation."""
REACH_PX = 12.0
"""Largest distance of an observation from its prediction, pixels."""
FLOOR_PX = 0.1
"""Alignment error of a perfect patch where the noise is 1, pixels: 0.08 px where it is 0.8."""
NOISE = 0.8
"""Standard deviation of intensities in aligned patches, in deviations of a patch."""
MIN_VIEWS = 3
"""Frames that must agree on a landmark."""
MAX_RESIDUAL_PX = 0.85
"""Largest root mean square residual of a landmark per axis, pixels."""


@dataclass(eq=False)
class KeyframeTracks:
    """A keyframe while its map is built."""

    frame: int
    """Its number in the recording."""
    landmarks: Landmarks
    """Landmarks with their current depths."""
    cell_inverse_depth: np.ndarray
    """(cells,) inverse depth of every cell, per metre."""
    patches: tuple[Patches, ...]
    """Templates of the landmarks in every pyramid level."""
    sources: tuple[int, ...]
    """Frames that see the same surfaces under parallax."""
    confirmed: BoolArray
    """(n,) landmarks that enough frames agree on."""


class Observations(NamedTuple):
    """Landmarks of one keyframe in other frames."""

    landmark: IntArray
    """(m,)."""
    frame: IntArray
    """(m,)."""
    pixels: Array
    """(m, 2)."""
    whitening: Array
    """(m, 2, 2), see `patches.whitening`."""


def open_keyframe(
    recording: PreparedFrames, frame: int, others: int = SWEPT_FRAMES
) -> KeyframeTracks:
    """Landmarks of a keyframe, with depths from a plane sweep over at most `others` frames."""
    view = recording.posed_cells(frame)
    swept, _ = recording.swept(frame, others)
    inverse = swept.astype(float)
    near = recording.source_views(1 / inverse, view, others)
    cell_px = recording.cell_px(frame)
    pixels, cells = detect(recording.grey[frame], view.grid, cell_px)
    has_ray = np.isfinite(recording.cameras[frame].unproject(pixels)).all(1)
    pixels = pixels[has_ray]
    cells = cells[has_ray]
    slant = slopes(inverse, view.grid, cell_px)
    return KeyframeTracks(
        frame=frame,
        landmarks=Landmarks(pixels, inverse[cells], slant[cells], np.ones(len(cells))),
        cell_inverse_depth=inverse,
        patches=template_patches(recording, frame, pixels),
        sources=tuple(near),
        confirmed=np.zeros(len(cells), bool),
    )


def opened_keyframes(
    recording: PreparedFrames,
    frames: Sequence[int],
    on_progress: OnProgress,
    others: int = SWEPT_FRAMES,
) -> list[KeyframeTracks]:
    """Open keyframes in parallel and refine their depths."""

    def open_one(frame: int) -> KeyframeTracks:
        keyframe = open_keyframe(recording, frame, others)
        refine_depths(recording, keyframe)
        return keyframe

    opened = []
    with ThreadPoolExecutor(cores()) as pool:
        for keyframe in pool.map(open_one, frames):
            opened.append(keyframe)
            on_progress("mapping", len(opened), len(frames))
    return opened


def template_patches(
    recording: PreparedFrames,
    frame: int,
    pixels: Array,
) -> tuple[Patches, ...]:
    """Templates around (n, 2) pixels of a frame, in every pyramid level."""
    return tuple(
        cut_patches(image, to_level(pixels, level))
        for level, image in enumerate(recording.pyramid(frame))
    )


def tracked_keyframes(
    recording: PreparedFrames, tracks: Sequence[KeyframeTracks]
) -> Keyframes:
    """What is stored of keyframes: their confirmed landmarks."""
    numbers = np.array([keyframe.frame for keyframe in tracks])
    vlad = recording.encoder.vlad()
    images = []
    landmarks = []
    depths = []
    descriptors = []
    for keyframe in tracks:
        images.append(jpeg(recording.grey[keyframe.frame]))
        landmarks.append(keyframe.landmarks.take(np.flatnonzero(keyframe.confirmed)))
        depths.append(keyframe.cell_inverse_depth.astype(np.float16))
        descriptors.append(vlad(recording.features(keyframe.frame)))
    return Keyframes(
        images=tuple(images),
        cameras=tuple(recording.cameras[i] for i in numbers),
        base_from_camera=recording.poses[numbers],
        inverse_depth=tuple(depths),
        landmarks=tuple(landmarks),
        descriptors=np.stack(descriptors).astype(np.float16),
    )


def observe(
    recording: PreparedFrames,
    keyframe: KeyframeTracks,
    frame: int,
    which: IntArray,
    steps: Steps,
    reach_px: float,
) -> Observations:
    """Align landmarks of a keyframe in another frame.

    `which` (n,) selects landmarks. An observation is at most `reach_px` from its prediction.
    """
    surface = keyframe.landmarks.take(which).surface(recording.cameras[keyframe.frame])
    rotation, translation = recording.relative(frame, keyframe.frame)
    camera = recording.cameras[frame]
    visible, expected, affines = project_surface(surface, rotation, translation, camera)
    which = which[visible]
    templates = tuple(level.take(which) for level in keyframe.patches)
    pixels, correlation = align_down(
        templates,
        recording.pyramid(frame),
        expected,
        affines,
        steps,
    )
    good = correlation > MIN_CORRELATION
    good &= norms(pixels - expected) < reach_px
    last = steps[-1][0]
    spread = templates[last].inverse_hessian[good]
    white = (
        whitening(affines[good], spread, FLOOR_PX, NOISE).transpose(2, 0, 1) / 2**last
    )
    return Observations(which[good], np.full(good.sum(), frame), pixels[good], white)


def refine_depths(
    recording: PreparedFrames,
    keyframe: KeyframeTracks,
    again: bool = False,
) -> None:
    """Refine the inverse depths of a keyframe's landmarks by Gauss-Newton; poses are fixed.

    Landmarks change in place. If the depths are nearly right (`again`), the coarse round is left
    out.
    """
    if not keyframe.sources or not len(keyframe.landmarks):
        return
    observations = None
    which = np.arange(len(keyframe.landmarks))
    for steps, updates in _DEPTH_ROUNDS[again:]:
        parts = [
            observe(
                recording,
                keyframe,
                j,
                which,
                steps,
                REACH_PX,
            )
            for j in keyframe.sources
        ]
        observations = joined(parts)
        # Landmarks with too few observations at a coarse level are not tried at a finer one.
        count = np.bincount(observations.landmark, minlength=len(keyframe.landmarks))
        which = np.flatnonzero(count >= MIN_VIEWS - 1)
        for _ in range(updates):
            _update_depths(recording, keyframe, observations)
    assert observations, "there is at least one round"
    _confirm(recording, keyframe, observations)


def joined(parts: Sequence[Observations]) -> Observations:
    """Several sets of observations as one."""
    return Observations(*map(np.concatenate, zip(*parts, strict=True)))


class _Residuals(NamedTuple):
    """Residuals of m observations at the current depths."""

    pixels: Array
    """(m, 2)."""
    whitened: Array
    """(m, 2)."""
    by_depth: Array
    """(m, 2) derivatives of the predicted whitened pixels by the inverse depth."""
    weight: Array
    """(m,) robust weights."""


def _residuals(
    recording: PreparedFrames,
    keyframe: KeyframeTracks,
    observations: Observations,
) -> _Residuals:
    rays = recording.cameras[keyframe.frame].unproject(keyframe.landmarks.pixels)
    rho = keyframe.landmarks.inverse_depth
    pixels, slope = np.zeros((2, len(observations.frame), 2))
    for j in keyframe.sources:
        rows = observations.frame == j
        which = observations.landmark[rows]
        camera = recording.cameras[j]
        rotation, translation = recording.relative(j, keyframe.frame)
        ray = rays[which] @ rotation.T
        step = 1e-4 * rho[which, None]
        predicted = camera.project(_in_front(ray + rho[which, None] * translation))
        beside = camera.project(
            _in_front(ray + (rho[which, None] + step) * translation)
        )
        valid = np.isfinite(predicted + beside).all(1, keepdims=True)
        pixels[rows] = np.where(
            valid, observations.pixels[rows] - predicted, _FAR_OFF_PX
        )
        slope[rows] = np.where(valid, (beside - predicted) / step, 0)
    whitened = np.einsum("nij,nj->ni", observations.whitening, pixels)
    slope = np.einsum("nij,nj->ni", observations.whitening, slope)
    return _Residuals(pixels, whitened, slope, 1 / (1 + (whitened**2).sum(1)))


def _in_front(points: Array) -> Array:
    """Points (n, 3) with a positive depth."""
    depth = np.maximum(points[:, 2:], 1e-3)
    return np.concatenate([points[:, :2], depth], 1)


def _update_depths(
    recording: PreparedFrames,
    keyframe: KeyframeTracks,
    observations: Observations,
) -> None:
    marks = keyframe.landmarks
    n = len(keyframe.landmarks)
    _, residual, slope, weight = _residuals(recording, keyframe, observations)
    which = observations.landmark
    gradient = np.bincount(which, weight * (slope * residual).sum(1), n)
    hessian = np.bincount(which, weight * (slope**2).sum(1), n) + 1e-9
    least = 0.6 / FAR_M
    most = 1.25 / NEAR_M
    rho = marks.inverse_depth
    scale = recording.depth_scale
    rho = rho + (gradient / hessian).clip(-0.15 * rho, 0.15 * rho)
    keyframe.landmarks = replace(
        marks, inverse_depth=rho.clip(least / scale, most / scale)
    )


def _confirm(
    recording: PreparedFrames,
    keyframe: KeyframeTracks,
    observations: Observations,
) -> None:
    n = len(keyframe.landmarks)
    pixels, residual, slope, weight = _residuals(recording, keyframe, observations)
    squares = (residual**2).sum(1)
    near = squares < _OUTLIER_SQUARES
    which = observations.landmark[near]
    count = np.bincount(which, minlength=n)
    axes = 2 * np.maximum(count, 1)
    mean = np.bincount(which, squares[near], n) / axes
    error_px = np.sqrt(np.bincount(which, (pixels[near] ** 2).sum(1), n) / axes)
    information = np.bincount(which, (weight * (slope**2).sum(1))[near], n)
    sigma = np.sqrt(np.maximum(mean, 0.5) / np.maximum(information, 1e-9))
    keyframe.landmarks = replace(keyframe.landmarks, sigma=sigma)
    keyframe.confirmed = (count >= MIN_VIEWS) & (error_px < MAX_RESIDUAL_PX)
