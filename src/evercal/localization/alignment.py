"""Alignment: landmarks are searched in an image to a tenth of a pixel, then the pose is refined."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evercal.geometry import SE3, Camera
from evercal.localization.intrinsics import (
    IntrinsicsPrior,
    RefinedPose,
    self_calibrated,
)
from evercal.localization.keyframe_bank import AlignedLandmarks
from evercal.localization.pnp import PnpOptions, solve_pnp
from evercal.localization.pose_refinement import (
    INTRINSICS,
    Observed,
    minimise,
)
from evercal.mapping.landmarks import project_surface
from evercal.mapping.patches import (
    Patches,
    align_patches,
    from_level,
    to_level,
    whitening,
)
from evercal.typing import Array, IntArray

Pose = tuple[Array, Array]
"""Rotation (3, 3) and position (3,) of map_from_camera."""

_MOST_AGAIN = 8
"""Searches after a change of the intrinsics, at most."""
_NOTICEABLE_PX = 0.2
"""Shift of projections by the intrinsics above which landmarks are searched again, pixels."""
_HOPELESS = 0.08
"""Share of the searched landmarks that must agree; with fewer the search ends."""
_FAR_PX = 1.0
"""Shift above which the coarse round is repeated, pixels."""


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
    """Share of matched landmarks below which the next round searches proportionally more."""
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


def align_pose(
    pyramid: Sequence[Array],
    camera: Camera,
    keyframes: Sequence[AlignedLandmarks],
    start: SE3,
    options: AlignmentOptions,
    prior: IntrinsicsPrior,
    change: Array | None = None,
    coarse: bool = True,
) -> RefinedPose | None:
    """Refine a rough pose by the landmarks of keyframes.

    The camera is that of the first level of the pyramid and the mean of the prior. The start is
    map_from_camera, roughly, with a change (5,) of the intrinsics; one that is known to some pixels
    needs no `coarse` search. Returns None if too few landmarks match.
    """
    search = _Search(pyramid, keyframes, options)
    pose = start.rotation_matrix(), start.translation_m
    rounds = options.rounds if coarse else options.rounds[1:]
    change = np.zeros(INTRINSICS) if change is None else change
    observed = None
    again = 0
    while True:
        passed = search.rounds(rounds, camera.changed(change), pose, observed)
        if passed is None:
            return None
        pose, observed = passed
        refined = self_calibrated(observed, camera, pose, change, prior)
        moved = _moved_px(camera, change, refined.change)
        if moved < _NOTICEABLE_PX:
            break
        if (
            refined.residual_px < options.inlier_px
        ).sum() < _HOPELESS * observed.expected:
            break  # other intrinsics do not make it the right place
        if again == _MOST_AGAIN:
            if prior.other_camera:
                break  # both are good, and it is undecided between them
            return None  # the intrinsics do not converge
        at = refined.pose.pose
        pose = (at.rotation_matrix(), at.translation_m)
        change = refined.change
        again += 1
        rounds = options.rounds if moved > _FAR_PX else options.rounds[-1:]
    enough = (refined.residual_px < options.inlier_px).sum() >= options.min_matches
    return refined if enough else None


def _moved_px(camera: Camera, before: Array, after: Array) -> float:
    change = after - before
    if not change.any():
        return 0.0
    across = [np.linspace(0, side - 1, 5) for side in (camera.width, camera.height)]
    plane = camera.pinhole.unproject(np.stack(np.meshgrid(*across), -1).reshape(-1, 2))[
        :, :2
    ]
    off = np.linalg.norm(camera.slopes(plane)[1] @ change, axis=-1)
    return float(np.sort(off[np.isfinite(off)])[-7])  # a fourth of the grid moves more


def _consistent(observed: Observed, camera: Camera) -> Pose | None:
    loose = PnpOptions(threshold_px=4.0, max_iterations=200, min_iterations=20)
    ideal = camera.pinhole.project(camera.unproject(observed.pixels))
    valid = np.isfinite(ideal).all(1)
    rough = solve_pnp(ideal[valid], observed.points_m[valid], camera, loose)
    if rough is None or rough.inliers.sum() < _HOPELESS * observed.expected:
        return None
    return rough.pose.rotation_matrix(), rough.pose.translation_m


class _Search:
    """Searches the landmarks of some keyframes, joined in their order, in an image."""

    def __init__(
        self,
        pyramid: Sequence[Array],
        keyframes: Sequence[AlignedLandmarks],
        options: AlignmentOptions,
    ):
        self.pyramid = pyramid
        self.keyframes = keyframes
        self.options = options
        surfaces = [keyframe.surface_m for keyframe in keyframes]
        self.starts = np.cumsum([0, *(surface.shape[1] for surface in surfaces)])
        self.surface_m = np.concatenate(surfaces, 1)
        # Displacement (n, 3) of a landmark by one standard deviation of its depth.
        self.depth_error_m = np.concatenate(
            [
                k.depth_noise[:, None] * (k.surface_m[0] - k.position_m)
                for k in keyframes
            ]
        )

    def patches(self, level: int, which: IntArray) -> Patches:
        """Templates of landmarks, indices in rising order."""
        ends = np.searchsorted(which, self.starts)
        spans = zip(self.keyframes, self.starts, ends, ends[1:], strict=False)
        return Patches.joined(
            [
                keyframe.patches[level].take(which[a:b] - start)
                for keyframe, start, a, b in spans
            ]
        )

    def rounds(
        self,
        rounds: Sequence[AlignmentRound],
        camera: Camera,
        pose: Pose,
        found: Observed | None,
    ) -> tuple[Pose, Observed] | None:
        """Search coarse to fine; return the matches of the last round and where it began."""
        for step in rounds:
            found = self.run(step, camera, pose, found)
            if found is None:
                return None
            if step is rounds[-1]:
                return pose, found
            rough = pose
            if step.level:
                # Many matches of the first round are wrong; RANSAC selects a consistent set.
                rough = _consistent(found, camera)
            if rough is None:
                return None
            at = minimise(found, camera, rough, step.steps)
            pose = at.rotation, at.position
        raise AssertionError("at least one round")

    def run(
        self, step: AlignmentRound, camera: Camera, pose: Pose, before: Observed | None
    ) -> Observed | None:
        """Match landmarks near their expected positions; None for too few matches."""
        options = self.options
        share = 1.0 if before is None else len(before.pixels) / before.expected
        more = max(1.0, options.enough_matched / max(share, 1e-3))
        most = int(min(more, options.most_more) * step.landmarks)
        rotation = pose[0].T
        shift = -rotation @ pose[1]
        which, pixels, affines = project_surface(
            self.surface_m, rotation, shift, camera, most
        )
        if not len(which):
            return None
        patches = self.patches(step.level, which)
        level = step.level
        start = to_level(pixels, level)
        image = self.pyramid[level]
        at, correlation = align_patches(patches, image, start, affines, step.iterations)
        at = from_level(at.astype(np.float64), level)
        good = correlation > options.min_correlation
        good &= np.linalg.norm(at - pixels, axis=1) < step.reach_px
        which = which[good]
        noise = options.noise * 2**level
        if len(which) < options.min_matches:
            return None
        points = self.surface_m[0, which]
        error = _shift_px(points, self.depth_error_m[which], rotation, shift, camera)
        hessian = patches.inverse_hessian[good]
        white = whitening(affines[good], hessian, options.floor_px, noise, error)
        return Observed(at[good], points, white, len(good))


def _shift_px(
    points: Array, moves: Array, rotation: Array, shift: Array, camera: Camera
) -> Array:
    """(n, 2) displacement in the image of points (n, 3) that move by `moves` (n, 3)."""
    local = points @ rotation.T + shift
    move = moves @ rotation.T
    plane = local[:, :2] / local[:, 2:]
    step = (move[:, :2] - plane * move[:, 2:]) / local[:, 2:]
    if not camera.distortion:
        return step * [camera.fx, camera.fy]
    return np.einsum("nij,nj->ni", camera.slopes(plane)[0], step)
