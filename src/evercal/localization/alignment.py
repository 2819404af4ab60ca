"""Alignment: landmarks are searched in an image to a tenth of a pixel, then the pose is refined."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError, require_numbers
from evercal.geometry import SE3, Camera, norms
from evercal.localization.intrinsics import IntrinsicsPrior
from evercal.localization.keyframe_bank import AlignedLandmarks
from evercal.localization.pnp import PnpOptions, solve_pnp
from evercal.localization.pose_refinement import (
    Minimum,
    Observed,
    Pose,
    minimise,
)
from evercal.localization.self_calibration import RefinedPose, self_calibrated
from evercal.mapping.landmarks import project_surface
from evercal.mapping.patches import (
    Patches,
    align_patches,
    from_level,
    to_level,
    whitening,
)
from evercal.typing import Array, IntArray

_MAX_REPEATS = 8
"""Maximum number of searches after a change of the intrinsics."""
_NOTICEABLE_PX = 0.2
"""Shift of projections by the intrinsics above which landmarks are searched again, pixels."""
_HOPELESS = 0.08
"""Share of the searched landmarks that must agree; with fewer the search ends."""
_FAR_PX = 1.0
"""Shift above which the coarse round is repeated, pixels."""
_LOOSE_PNP = PnpOptions(threshold_px=4.0, max_iterations=200)
"""RANSAC settings for the matches of the coarse round, many of which are wrong."""


@frozen
class AlignmentRound:
    """One pass over the landmarks."""

    level: int
    """Level of the image pyramid."""
    iterations: int
    """Alignment iterations of every patch."""
    landmarks: int
    """Maximum number of searched landmarks; more where few were matched before."""
    steps: int
    """Maximum number of Gauss-Newton iterations of the pose."""
    reach_px: float
    """Maximum distance of a match from its expected position, pixels of the image."""


@frozen
class AlignmentOptions:
    """How landmarks are searched in an image."""

    rounds: tuple[AlignmentRound, ...] = (
        AlignmentRound(
            level=1,
            iterations=6,
            landmarks=300,
            steps=3,
            reach_px=24.0,
        ),
        AlignmentRound(
            level=0,
            iterations=4,
            landmarks=300,
            steps=3,
            reach_px=6.0,
        ),
        AlignmentRound(
            level=0,
            iterations=3,
            landmarks=900,
            steps=10,
            reach_px=3.0,
        ),
    )
    """Rounds from coarse to fine."""
    enough_matched: float = 0.4
    """Share of matched landmarks below which the next round searches proportionally more."""
    most_more: float = 3.0
    """Maximum factor on the number of searched landmarks."""
    min_correlation: float = 0.7
    """Minimum normalised cross-correlation of a match."""
    min_matches: int = 12
    """Minimum number of matched landmarks of a pose."""
    inlier_px: float = 1.0
    """Reprojection error below which a matched landmark is an inlier, pixels."""
    floor_px: float = 0.1
    """Alignment error of a perfect patch for `noise` 1, pixels: with 0.8, 0.08 px at level 0."""
    noise: float = 0.8
    """Noise of aligned patches, in standard deviations of a patch's intensities."""

    def __post_init__(self) -> None:
        if len(self.rounds) < 2:
            raise InputError(
                "AlignmentOptions.rounds has fewer than two; the first is the coarse one"
            )
        for step in self.rounds:
            require_numbers(step, ("iterations", "landmarks", "steps"), 1)
            require_numbers(step, ("level",), 0, 1)
            require_numbers(step, ("reach_px",), 0)
        require_numbers(self, ("enough_matched", "min_correlation"), 0, 1)
        require_numbers(self, ("most_more", "min_matches"), 1)
        require_numbers(self, ("inlier_px", "floor_px", "noise"), 0)


class SearchedImage(NamedTuple):
    """The image that landmarks are searched in."""

    pyramid: Sequence[Array]
    camera: Camera
    """Intrinsics at the first level of the pyramid, the mean of the prior."""
    prior: IntrinsicsPrior


def align_pose(
    image: SearchedImage,
    keyframes: Sequence[AlignedLandmarks],
    start: SE3,
    change: Array,
    options: AlignmentOptions,
    coarse: bool = True,
) -> RefinedPose | None:
    """Refine a rough pose by the landmarks of keyframes; None if too few landmarks match.

    The start is map_from_camera, roughly, with a change (5,) of the intrinsics. A start that is
    known to some pixels needs no `coarse` search.
    """
    search = _Search(image.pyramid, keyframes, options)
    camera = image.camera
    pose = start.rotation_matrix(), start.translation_m
    rounds = options.rounds
    if not coarse:
        rounds = options.rounds[1:]
    observed = None
    repeats = 0
    while True:
        searched = search.rounds(rounds, camera.changed(change), pose, observed)
        if not searched:
            return None
        pose, observed = searched
        refined = self_calibrated(observed, camera, pose, change, image.prior)
        inliers = np.count_nonzero(refined.residual_px < options.inlier_px)
        shift_px = _shift_by_intrinsics_px(camera, refined.change - change)
        if shift_px < _NOTICEABLE_PX:
            break
        if inliers < _HOPELESS * observed.expected:
            break  # other intrinsics do not make it the right place
        if repeats == _MAX_REPEATS:
            if image.prior.other_camera:
                break  # both cameras fit
            return None  # the intrinsics do not converge
        start = refined.pose.pose
        pose = start.rotation_matrix(), start.translation_m
        change = refined.change
        repeats += 1
        rounds = options.rounds
        if shift_px <= _FAR_PX:
            rounds = options.rounds[-1:]
    if inliers < options.min_matches:
        return None
    return refined


def matches_at(
    image: SearchedImage,
    keyframes: Sequence[AlignedLandmarks],
    at: SE3,
    options: AlignmentOptions,
) -> Observed | None:
    """The landmarks of keyframes that match near their places in an image from a known pose.

    The pose is map_from_camera. None if too few match.
    """
    search = _Search(image.pyramid, keyframes, options)
    pose = at.rotation_matrix(), at.translation_m
    return search.run(options.rounds[-1], image.camera, pose, None)


def _shift_by_intrinsics_px(camera: Camera, change: Array) -> float:
    """Shift of pixels by a change (5,) of the intrinsics; a fourth of the image moves more."""
    if not change.any():
        return 0.0
    columns = np.linspace(0, camera.width - 1, 5)
    rows = np.linspace(0, camera.height - 1, 5)
    grid = np.meshgrid(columns, rows)
    pixels = np.stack(grid, -1).reshape(-1, 2)
    rays = camera.pinhole.unproject(pixels)
    _, by_intrinsics = camera.slopes(rays[:, :2])
    shifts = norms(by_intrinsics @ change)
    shifts = shifts[np.isfinite(shifts)]
    return float(np.sort(shifts)[-7])


def _disagree(minimum: Minimum) -> bool:
    """Whether at most half of the matches agree with a pose."""
    return bool(np.median(minimum.residual_px) > _LOOSE_PNP.threshold_px)


def _consistent(observed: Observed, camera: Camera) -> Pose | None:
    """The pose that most matches agree with, by RANSAC; None if few do."""
    rays = camera.unproject(observed.pixels)
    ideal = camera.pinhole.project(rays)
    valid = np.isfinite(ideal).all(1)
    points = observed.points_m[valid]
    rough = solve_pnp(ideal[valid], points, camera, _LOOSE_PNP)
    if not rough or rough.inlier_count < _HOPELESS * observed.expected:
        return None
    pose = rough.pose
    return pose.rotation_matrix(), pose.translation_m


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
        surfaces = []
        depth_errors = []
        for keyframe in keyframes:
            surface = keyframe.surface_m
            surfaces.append(surface)
            ray = surface[0] - keyframe.position_m
            depth_errors.append(keyframe.depth_noise[:, None] * ray)
        counts = [surface.shape[1] for surface in surfaces]
        self.starts = np.cumsum([0, *counts])
        self.surface_m = np.concatenate(surfaces, 1)
        # Displacement (n, 3) of a landmark by one standard deviation of its depth.
        self.depth_error_m = np.concatenate(depth_errors)

    def patches(self, level: int, landmarks: IntArray) -> Patches:
        """Templates of landmarks, indices in rising order."""
        ends = np.searchsorted(landmarks, self.starts)
        patches = []
        for number, keyframe in enumerate(self.keyframes):
            shown = landmarks[ends[number] : ends[number + 1]]
            patches.append(keyframe.patches[level].take(shown - self.starts[number]))
        return Patches.joined(patches)

    def rounds(
        self,
        rounds: Sequence[AlignmentRound],
        camera: Camera,
        pose: Pose,
        observed: Observed | None,
    ) -> tuple[Pose, Observed] | None:
        """Search coarse to fine; return the matches of the last round and where it began."""
        *earlier, last = rounds
        for step in earlier:
            observed = self.run(step, camera, pose, observed)
            if not observed:
                return None
            minimum = minimise(observed, camera, pose, step.steps)
            if step.level and _disagree(minimum):
                rough = _consistent(observed, camera)
                if not rough:
                    return None
                minimum = minimise(observed, camera, rough, step.steps)
            pose = minimum.rotation, minimum.position
        observed = self.run(last, camera, pose, observed)
        if not observed:
            return None
        return pose, observed

    def run(
        self, step: AlignmentRound, camera: Camera, pose: Pose, before: Observed | None
    ) -> Observed | None:
        """Match landmarks near their expected positions; None for too few matches."""
        options = self.options
        level = step.level
        most = step.landmarks
        if before:
            share = len(before.pixels) / before.expected
            more = max(1.0, options.enough_matched / max(share, 1e-3))
            most = int(min(more, options.most_more) * step.landmarks)
        rotation = pose[0].T
        shift = -rotation @ pose[1]
        landmarks, pixels, affines = project_surface(
            self.surface_m, rotation, shift, camera, most
        )
        if not len(landmarks):
            return None
        patches = self.patches(level, landmarks)
        start = to_level(pixels, level)
        image = self.pyramid[level]
        matched, correlation = align_patches(
            patches, image, start, affines, step.iterations
        )
        matched = from_level(matched.astype(float), level)
        good = correlation > options.min_correlation
        good &= norms(matched - pixels) < step.reach_px
        landmarks = landmarks[good]
        if len(landmarks) < options.min_matches:
            return None
        points = self.surface_m[0, landmarks]
        moves = self.depth_error_m[landmarks]
        error = _shift_px(points, moves, rotation, shift, camera)
        white = whitening(
            affines[good],
            patches.inverse_hessian[good],
            options.floor_px,
            options.noise * 2**level,
            error,
        )
        return Observed(matched[good], points, white, len(good))


def _shift_px(
    points: Array, moves: Array, rotation: Array, shift: Array, camera: Camera
) -> Array:
    """(n, 2) displacement in the image of points (n, 3) that move by `moves` (n, 3)."""
    local = points @ rotation.T + shift
    move = moves @ rotation.T
    depth = local[:, 2:]
    plane = local[:, :2] / depth
    step = (move[:, :2] - plane * move[:, 2:]) / depth
    if not camera.distortion:
        return step * [camera.fx, camera.fy]
    by_plane, _ = camera.slopes(plane)
    return np.einsum("nij,nj->ni", by_plane, step)
