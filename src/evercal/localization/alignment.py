"""Alignment: landmarks of keyframes are found in an image to a tenth of a pixel, then the pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.keyframe_bank import AlignedLandmarks
from evercal.localization.pnp import PnpOptions, solve_pnp
from evercal.localization.pose_refinement import RefinedPose, refine_pose
from evercal.mapping.landmarks import project_surface
from evercal.mapping.patches import Patches, align_patches, from_level, to_level, whitening

Array = NDArray[np.floating]


@dataclass(frozen=True)
class AlignmentRound:
    """One pass over the landmarks."""

    level: int
    """Of the image pyramid."""
    iterations: int
    """Alignment steps of every patch."""
    landmarks: int
    """Landmarks looked for, at most; more of them where few are found."""
    steps: int
    """Steps of the pose, at most."""
    reach_px: float
    """How far from where it was expected a landmark may be found, pixels of the image."""


@dataclass(frozen=True)
class AlignmentOptions:
    """How landmarks are looked for in an image."""

    rounds: tuple[AlignmentRound, ...] = (
        AlignmentRound(1, 6, 300, 3, 24.0),
        AlignmentRound(0, 4, 300, 3, 6.0),
        AlignmentRound(0, 3, 900, 10, 3.0),
    )
    """From coarse to fine."""
    enough_found: float = 0.4
    """Where a smaller share of the landmarks was found in one round, the next looks for as many
    more,"""
    most_more: float = 3.0
    """but at most for so many times as many: of an image that is covered, or seen from far, the
    precision lies in the few that can be found."""
    min_correlation: float = 0.7
    """Smallest normalised cross-correlation of a landmark that was found."""
    min_found: int = 12
    """Fewer landmarks make no pose."""
    found_px: float = 1.0
    """A landmark agrees with the pose when it was found this near to where it should be."""
    floor_px: float = 0.1
    """Alignment error of a perfect patch where `noise` is 1, pixels: with 0.8, 0.08 px at level 0.
    """
    noise: float = 0.8
    """Standard deviation of intensities in aligned patches, in deviations of a patch."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The pose that landmarks tell, and how many of them agree."""

    pose: RefinedPose
    """In the base frame of the scene."""
    expected: int
    """Landmarks that should be visible and were looked for."""
    matched: int
    """Landmarks whose patch was found near where it was expected."""
    pixels: Array
    """(n, 2) landmarks that agree, pixels of the image."""
    points_m: Array
    """(n, 3) the same in the base frame."""
    planned: int
    """Landmarks that the last round would have looked for, had enough of them been found before."""

    @property
    def share(self) -> float:
        """Landmarks that agree as a share of those looked for."""
        return len(self.pixels) / max(self.expected, 1)


@dataclass(frozen=True, eq=False)
class _Found:
    expected: int
    pixels: Array
    """(n, 2) of the image."""
    ideal: Array
    """(n, 2) the same of the ideal pinhole."""
    lens: Array | None
    """(n, 2, 2) how the former move with the latter; None without distortion."""
    points_m: Array
    whitening: Array
    """(n, 2, 2) of errors in the image."""


@dataclass(frozen=True, eq=False)
class _Target:
    """The landmarks of some keyframes as one set."""

    keyframes: Sequence[AlignedLandmarks]
    starts: NDArray[np.int64]
    """(keyframes + 1,) the first landmark of each, and their number."""
    surface_m: Array
    """(3, n, 3), see `AlignedLandmarks`."""
    depth_error_m: Array
    """(n, 3) where a landmark may move for its depth is uncertain: one standard deviation."""

    @classmethod
    def of(cls, keyframes: Sequence[AlignedLandmarks]) -> Self:
        """Of keyframes in their order."""
        surfaces = [keyframe.surface_m for keyframe in keyframes]
        counts = [surface.shape[1] for surface in surfaces]
        errors = [k.depth_noise[:, None] * (k.surface_m[0] - k.position_m) for k in keyframes]
        starts = np.cumsum([0, *counts])
        return cls(keyframes, starts, np.concatenate(surfaces, 1), np.concatenate(errors))

    def patches(self, level: int, which: NDArray[np.int64]) -> Patches:
        """Templates of some landmarks in rising order."""
        ends = np.searchsorted(which, self.starts)
        parts = [
            keyframe.patches[level].take(which[a:b] - start)
            for keyframe, start, a, b in zip(
                self.keyframes, self.starts, ends, ends[1:], strict=False
            )
        ]
        return Patches.joined(parts)


def align_pose(
    pyramid: Sequence[Array],
    camera: Camera,
    keyframes: Sequence[AlignedLandmarks],
    start: SE3,
    options: AlignmentOptions,
) -> Alignment | None:
    """Refines a rough pose by the landmarks of keyframes.

    Args:
        pyramid: of the image, see `image_pyramid`.
        camera: intrinsics of its first level, distortion included.
        keyframes: the landmarks of some that show the same place.
        start: base_from_camera, roughly.
        options: how.

    Returns:
        None where too few landmarks are found.
    """
    pose, refined, found = start, None, None
    target = _Target.of(keyframes)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    for number, step in enumerate(options.rounds):
        share = 1.0 if found is None else len(found.pixels) / found.expected
        more = min(max(1.0, options.enough_found / max(share, 1e-3)), options.most_more)
        wider = replace(step, landmarks=int(more * step.landmarks))
        found = _look(pyramid, camera, target, pose, wider, options)
        if len(found.pixels) < options.min_found:
            return None
        if number == 0:
            # Of the first round many are wrong: a sample consensus tells which agree.
            loose = PnpOptions(threshold_px=4.0, max_iterations=200, min_iterations=20)
            rough = solve_pnp(found.ideal, found.points_m, intrinsics, loose)
            if rough is None:
                return None
            pose = rough.world_from_camera
        refined = refine_pose(
            found.ideal, found.points_m, found.whitening, intrinsics, pose, step.steps, found.lens
        )
        pose = refined.base_from_camera
    assert refined is not None
    assert found is not None
    agree = refined.residual_px < options.found_px
    if agree.sum() < options.min_found:
        return None
    return Alignment(
        refined,
        found.expected,
        len(found.pixels),
        found.pixels[agree],
        found.points_m[agree],
        min(found.expected, options.rounds[-1].landmarks),
    )


def _look(
    pyramid: Sequence[Array],
    camera: Camera,
    target: _Target,
    pose: SE3,
    step: AlignmentRound,
    options: AlignmentOptions,
) -> _Found:
    """Landmarks of all keyframes in one round."""
    inverse = pose.inverse()
    turn, shift = inverse.rotation_matrix(), inverse.translation_m
    which, pixels, affines = project_surface(target.surface_m, turn, shift, camera)
    every = max(1, -(-len(which) // step.landmarks))
    which, pixels, affines = which[::every], pixels[::every], affines[::every]
    if not len(which):
        none = np.zeros((0, 2))
        return _Found(0, none, none, None, np.zeros((0, 3)), np.zeros((0, 2, 2)))
    patches = target.patches(step.level, which)
    at, correlation = align_patches(
        patches, pyramid[step.level], to_level(pixels, step.level), affines, step.iterations
    )
    at = from_level(at.astype(np.float64), step.level)
    good = correlation > options.min_correlation
    good &= np.linalg.norm(at - pixels, axis=1) < step.reach_px
    ideal, lens = _through_lens(at, camera)
    good &= np.isfinite(ideal).all(1)
    if lens is not None:
        good &= np.isfinite(lens).all((1, 2))
        lens = lens[good]
    spread = patches.inverse_hessian[good]
    which, noise = which[good], options.noise * 2**step.level
    points = target.surface_m[0, which]
    error = _shift_px(points, target.depth_error_m[which], turn, shift, camera)
    if lens is not None:
        error = np.einsum("nij,nj->ni", lens, error)
    white = whitening(affines[good], spread, options.floor_px, noise, error)
    return _Found(len(good), at[good], ideal[good], lens, points, white)


def _shift_px(points: Array, moves: Array, turn: Array, shift: Array, camera: Camera) -> Array:
    """(n, 2) how far points (n, 3) move in the ideal pinhole where they move by `moves` (n, 3)."""
    local, move = points @ turn.T + shift, moves @ turn.T
    plane = move[:, :2] - local[:, :2] * (move[:, 2:] / local[:, 2:])
    return plane / local[:, 2:] * [camera.fx, camera.fy]


def _through_lens(pixels: Array, camera: Camera) -> tuple[Array, Array | None]:
    """(n, 2) pixels of the ideal pinhole, and (n, 2, 2) how pixels of the image move with them."""
    if not camera.distortion:
        return pixels, None
    plane, focal = camera.unproject(pixels)[:, :2], np.array([camera.fx, camera.fy])
    by_plane, _ = camera.slopes(plane)
    return plane * focal + [camera.cx, camera.cy], by_plane / focal
