"""Alignment: landmarks are searched in an image to a tenth of a pixel, then the pose is refined."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import SE3, Camera, UncertainPose
from evercal.localization.keyframe_bank import AlignedLandmarks
from evercal.localization.pnp import PnpOptions, solve_pnp
from evercal.localization.pose_refinement import refine_pose
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
    """Landmarks that are searched, at most; more where few were matched before."""
    steps: int
    """Gauss-Newton steps of the pose, at most."""
    reach_px: float
    """Largest distance of a match from its expected position, pixels of the image."""


@dataclass(frozen=True)
class AlignmentOptions:
    """How landmarks are searched in an image."""

    rounds: tuple[AlignmentRound, ...] = (
        AlignmentRound(1, 6, 300, 3, 24.0),
        AlignmentRound(0, 4, 300, 3, 6.0),
        AlignmentRound(0, 3, 900, 10, 3.0),
    )
    """From coarse to fine."""
    enough_matched: float = 0.4
    """If a smaller share of the landmarks was matched in one round, the next round searches
    proportionally more. An occluded or distant view yields few matches per landmark."""
    most_more: float = 3.0
    """Largest factor on the number of landmarks."""
    min_correlation: float = 0.7
    """Smallest normalised cross-correlation of a match."""
    min_matches: int = 12
    """Fewer landmarks give no pose."""
    inlier_px: float = 1.0
    """Reprojection error below which a matched landmark is an inlier."""
    floor_px: float = 0.1
    """Alignment error of a perfect patch for `noise` 1, pixels: with 0.8, 0.08 px at level 0."""
    noise: float = 0.8
    """Noise of aligned patches, in standard deviations of a patch's intensities."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """A pose refined by landmarks, and its inliers."""

    pose: UncertainPose
    """map_from_camera."""
    pixels: Array
    """(n, 2) inliers, pixels of the image."""
    points_m: Array
    """(n, 3) their landmarks in the map's frame."""
    expected: int
    """Landmarks that should be visible and were searched."""
    matched: int
    """Landmarks whose patch was found near the expected position."""
    planned: int
    """Landmarks that the last round would search in an unobstructed image."""


@dataclass(frozen=True, eq=False)
class _Matched:
    """Landmarks matched in one round."""

    expected: int
    """Landmarks that were searched."""
    pixels: Array
    """(n, 2) of the image."""
    ideal: Array
    """(n, 2) the same in the ideal pinhole."""
    distortion: Array | None
    """(n, 2, 2) derivatives of `pixels` by `ideal`; None without distortion."""
    points_m: Array
    """(n, 3) in the map's frame."""
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
    """(n, 3) displacement of a landmark by one standard deviation of its depth."""

    @classmethod
    def of(cls, keyframes: Sequence[AlignedLandmarks]) -> Self:
        """Join the landmarks of keyframes in their order."""
        surfaces = [keyframe.surface_m for keyframe in keyframes]
        counts = [surface.shape[1] for surface in surfaces]
        errors = [k.depth_noise[:, None] * (k.surface_m[0] - k.position_m) for k in keyframes]
        starts = np.cumsum([0, *counts])
        return cls(keyframes, starts, np.concatenate(surfaces, 1), np.concatenate(errors))

    def patches(self, level: int, which: NDArray[np.int64]) -> Patches:
        """Templates of landmarks, indices in rising order."""
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
    """Refine a rough pose by the landmarks of keyframes.

    The camera is that of the first level of the pyramid, and the start is map_from_camera, roughly.
    Returns None if too few landmarks match.
    """
    pose, refined, matched = start, None, None
    target = _Target.of(keyframes)
    for number, step in enumerate(options.rounds):
        share = 1.0 if matched is None else len(matched.pixels) / matched.expected
        more = min(max(1.0, options.enough_matched / max(share, 1e-3)), options.most_more)
        wider = replace(step, landmarks=int(more * step.landmarks))
        matched = _search(pyramid, camera, target, pose, wider, options)
        if len(matched.pixels) < options.min_matches:
            return None
        if number == 0:
            # Many matches of the first round are wrong; RANSAC selects a consistent set.
            loose = PnpOptions(threshold_px=4.0, max_iterations=200, min_iterations=20)
            rough = solve_pnp(matched.ideal, matched.points_m, camera, loose)
            if rough is None:
                return None
            pose = rough.pose.pose
        refined = refine_pose(
            matched.ideal,
            matched.points_m,
            matched.whitening,
            camera,
            pose,
            step.steps,
            matched.distortion,
        )
        pose = refined.pose.pose
    assert refined is not None, "at least one round"
    assert matched is not None, "at least one round"
    inliers = refined.residual_px < options.inlier_px
    if inliers.sum() < options.min_matches:
        return None
    return Alignment(
        refined.pose,
        matched.pixels[inliers],
        matched.points_m[inliers],
        matched.expected,
        len(matched.pixels),
        min(matched.expected, options.rounds[-1].landmarks),
    )


def _search(
    pyramid: Sequence[Array],
    camera: Camera,
    target: _Target,
    pose: SE3,
    step: AlignmentRound,
    options: AlignmentOptions,
) -> _Matched:
    """Match the landmarks of all keyframes near their expected positions."""
    inverse = pose.inverse()
    rotation, shift = inverse.rotation_matrix(), inverse.translation_m
    which, pixels, affines = project_surface(target.surface_m, rotation, shift, camera)
    if len(which) > step.landmarks:
        spread = np.linspace(0, len(which) - 1, step.landmarks).round().astype(int)
        which, pixels, affines = which[spread], pixels[spread], affines[spread]
    if not len(which):
        empty = np.zeros((0, 2))
        return _Matched(0, empty, empty, None, np.zeros((0, 3)), np.zeros((0, 2, 2)))
    patches = target.patches(step.level, which)
    at, correlation = align_patches(
        patches, pyramid[step.level], to_level(pixels, step.level), affines, step.iterations
    )
    at = from_level(at.astype(np.float64), step.level)
    good = correlation > options.min_correlation
    good &= np.linalg.norm(at - pixels, axis=1) < step.reach_px
    ideal, distortion = _undistorted(at, camera)
    good &= np.isfinite(ideal).all(1)
    if distortion is not None:
        good &= np.isfinite(distortion).all((1, 2))
        distortion = distortion[good]
    spread = patches.inverse_hessian[good]
    which, noise = which[good], options.noise * 2**step.level
    points = target.surface_m[0, which]
    error = _shift_px(points, target.depth_error_m[which], rotation, shift, camera)
    if distortion is not None:
        error = np.einsum("nij,nj->ni", distortion, error)
    white = whitening(affines[good], spread, options.floor_px, noise, error)
    return _Matched(len(good), at[good], ideal[good], distortion, points, white)


def _shift_px(points: Array, moves: Array, rotation: Array, shift: Array, camera: Camera) -> Array:
    """(n, 2) displacement in the ideal pinhole of points (n, 3) that move by `moves` (n, 3)."""
    local, move = points @ rotation.T + shift, moves @ rotation.T
    plane = move[:, :2] - local[:, :2] * (move[:, 2:] / local[:, 2:])
    return plane / local[:, 2:] * [camera.fx, camera.fy]


def _undistorted(pixels: Array, camera: Camera) -> tuple[Array, Array | None]:
    """(n, 2) pixels of the ideal pinhole, and (n, 2, 2) derivatives of image pixels by them."""
    if not camera.distortion:
        return pixels, None
    plane, focal = camera.unproject(pixels)[:, :2], np.array([camera.fx, camera.fy])
    by_plane, _ = camera.slopes(plane)
    return plane * focal + [camera.cx, camera.cy], by_plane / focal
