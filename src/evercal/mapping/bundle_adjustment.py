"""Bundle adjustment of a recording whose poses and intrinsics are measurements.

Unknown are the inverse depth of every landmark, a correction of every frame's pose, one transform
common to all frames (an error of `gripper_from_camera`), a constant time shift between poses and
images, and the intrinsics. Where joint values of an arm are stated, so are their offsets. Gaussian
priors tie them to the stated values. The variances of the priors are estimated from the recording
(variance components: Foerstner and Wrobel, Photogrammetric Computer Vision, 2016, section 4.2.4;
relevance of single parameters: MacKay, Bayesian interpolation, 1992). So parameters that the images
do not constrain keep their stated values.

The steps are Levenberg-Marquardt. Landmarks are eliminated by the Schur complement, which leaves
dense normal equations with six rows a frame: 8 (6 n + 15)^2 bytes, and time in proportion to n^3.
`MapOptions.support_frames` bounds n; 350 frames take 36 MB.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms
from evercal.mapping.bundle_equations import (
    COMMON,
    INTRINSICS,
    Adjustment,
    BundleTracks,
    Linearised,
    NormalEquations,
    Parameters,
    Solution,
    StatedFrames,
)
from evercal.mapping.bundle_options import FIXED, BundleOptions
from evercal.mapping.changed_lens import focal_changes
from evercal.mapping.stated_errors import StatedErrors, Variances
from evercal.mapping.variance_components import (
    HIDDEN,
    by_shared,
    left_out,
    noise_of,
    pose_sigma,
    shared_variances,
    student_weights,
    systematic_covariance,
)
from evercal.typing import Array

INVALID_SQUARES = 1e8
"""Squared residual that an observation without a projection counts with."""
FIRST_DAMPING = 1e-4
"""Levenberg-Marquardt damping after the first rejected step."""
MAX_RAISES = 8
"""Maximum number of rejected steps in a row."""
ROUNDING = 1e-9
"""Share by which rounding may raise the cost of an accepted step."""
MAX_DEPTH_STEP = 0.2
"""Largest change of an inverse depth in one step, as a share of it."""
LEAST_INVERSE_DEPTH = 0.03
"""Lower bound of inverse depths, per metre, in a room; see `BundleTracks.depth_scale`."""
MOST_INVERSE_DEPTH = 6
"""Upper bound of inverse depths, per metre, in a room."""
FREE_ITERATIONS = 2
"""Iterations before the variances of shared parameters are estimated."""
DETERMINED = 0.05
"""An offset is determined if its variance by the images alone is below this share of its prior."""
MIN_INFORMATION = 1e-9
"""Lower bound of the information of the images on an offset, which is a divisor."""
SHARED_STEPS = 3
"""Steps after errors that stated poses share are taken in."""
CONVERGED = 1e-9
"""Adjustment ends when a step is this small, in standard deviations, and variances change by less
than this share."""


@frozen_arrays
class Estimate:
    """Parameters, their linearisation, and the factor of their covariance."""

    parameters: Parameters
    linearised: Linearised
    root: Array
    """The covariance of corrections and shared parameters is root.T @ root."""
    damping: float = 0.0
    """Levenberg-Marquardt damping of the next step."""
    step: float = 0.0
    """Length of the last step, in standard deviations."""


class BundleAdjustment:
    """The problem of one recording.

    Cameras are those of the image size that patches are cut from, and adjusted if all are the same
    but for the principal point.
    """

    def __init__(
        self,
        stated: SE3,
        cameras: list[Camera],
        errors: StatedErrors,
        options: BundleOptions,
    ):
        self.options = options
        self.errors = errors
        self.n = errors.n
        self.frames = StatedFrames(stated, cameras)
        self.moves = bool(np.abs(errors.motion[:, :, COMMON]).max(initial=0) > 0)
        """Whether a time shift has an effect."""
        self.camera = cameras[0]
        self.adjusts_camera = options.intrinsics and self.frames.same_lens
        """Whether intrinsics are adjusted."""

    def solve(self, tracks: BundleTracks) -> Adjustment:
        """Estimate all parameters."""
        widest = self.start_variances()
        estimate = self.start(tracks)
        variances = widest
        for i in range(self.options.iterations):
            estimate = self.step(tracks, estimate, variances)
            before = variances
            variances = self._pose_variances(estimate, before)
            if i >= FREE_ITERATIONS:
                shared = shared_variances(
                    estimate.parameters.shared,
                    estimate.root[:, 6 * self.n :],
                    before.shared,
                    widest.shared,
                    self.errors.offsets,
                    self.options,
                )
                variances = replace(variances, shared=shared)
            if estimate.step < CONVERGED and variances.close_to(before, CONVERGED):
                break
        if self.errors.kinds:
            estimate, variances = self._with_shared(tracks, estimate, variances)
        return self._result(tracks, estimate, variances)

    def _with_shared(
        self, tracks: BundleTracks, estimate: Estimate, variances: Variances
    ) -> tuple[Estimate, Variances]:
        """Adjust again with errors that stated poses share, where the images ask for them."""
        from evercal.mapping.shared_levels import shared_levels

        levels = shared_levels(
            self.errors.at_origin(estimate.parameters),
            self.errors.of_rows(estimate.root),
            variances.weight,
            variances.sigma,
            self.errors.kinds,
        )
        if levels is None:
            return estimate, variances
        sigma = np.sqrt(np.repeat(levels[:2], 3))
        variances = replace(variances, sigma=sigma, of_kinds=levels[2:])
        for _ in range(SHARED_STEPS):
            estimate = self.step(tracks, estimate, variances)
        return estimate, variances

    def start(self, tracks: BundleTracks) -> Estimate:
        """The stated values."""
        shared = np.zeros(self.errors.size)
        shared[self.errors.offsets] = self.errors.joints.at
        parameters = Parameters(np.zeros((self.n, 6)), shared, tracks.inverse_depth)
        linearised = self.frames.linearise(tracks, parameters)
        return Estimate(parameters, linearised, np.zeros((0, 0)))

    def start_variances(self) -> Variances:
        """Priors before they are estimated."""
        o = self.options
        shift = FIXED
        if self.moves:
            shift = o.shift_sigma_frames
        intrinsics = np.full(INTRINSICS, FIXED)
        if self.adjusts_camera:
            intrinsics = o.intrinsics_sigma(self.camera)
        angles = np.deg2rad([o.start_sigma_deg, o.common_sigma_deg, o.joint_sigma_deg])
        common = np.repeat([o.common_sigma_m, angles[1]], 3)
        joints = np.where(self.errors.joints.rotates, angles[2], o.joint_sigma_m)
        return Variances(
            sigma=np.repeat([o.start_sigma_m, angles[0]], 3),
            weight=np.ones(self.n),
            shared=np.concatenate([common, [shift], joints, intrinsics]) ** 2,
        )

    def step(
        self,
        tracks: BundleTracks,
        estimate: Estimate,
        variances: Variances,
    ) -> Estimate:
        """One Levenberg-Marquardt step at fixed variances.

        A step that raises the cost is rejected, and the damping is multiplied by 10. The first
        damping is 0: then the step is that of Gauss and Newton.

        Raises:
            InputError: The images do not determine the poses.
        """
        noise = noise_of(estimate.linearised)
        normal = self._normal_equations(tracks, estimate, variances, noise)
        most = self.cost(estimate, variances, noise) * (1 + ROUNDING)
        undamped = normal.solve(0.0)
        solution = undamped
        damping = estimate.damping
        root = None
        # The damping of a step does not make its parameters more certain.
        if undamped:
            root = undamped.root
        for _ in range(MAX_RAISES + 1):
            if damping:
                solution = normal.solve(damping)
            if solution:
                if root is None:
                    root = solution.root
                moved = self._moved(tracks, estimate, solution, root)
                if self.cost(moved, variances, noise) <= most:
                    if damping > FIRST_DAMPING:
                        moved = replace(moved, damping=damping / 10)
                    return moved
            damping = max(10 * damping, FIRST_DAMPING)
        if root is None:
            raise InputError(
                "bundle adjustment: the images do not determine the poses of this recording; record"
                " it with more parallax, or check that the stated poses belong to these images"
            )
        # No step lowers the cost: this is its minimum.
        return Estimate(estimate.parameters, estimate.linearised, root)

    def cost(
        self,
        estimate: Estimate,
        variances: Variances,
        noise: float,
    ) -> float:
        """Twice the negative logarithm of the posterior: Cauchy residuals and Gaussian priors."""
        linearised = estimate.linearised
        squares = (linearised.residual**2).sum(1)
        squares[~linearised.valid] = INVALID_SQUARES
        data = np.log1p(squares / noise**2).sum() / self.options.correlation**2
        errors = self.errors.at_origin(estimate.parameters)
        noise_of_poses = self.errors.noise(variances)
        poses = errors * noise_of_poses.weighted(errors[..., None])[..., 0]
        shared = estimate.parameters.shared**2 / variances.shared
        return float(data + poses.sum() + shared.sum())

    def _normal_equations(
        self,
        tracks: BundleTracks,
        estimate: Estimate,
        variances: Variances,
        noise: float,
    ) -> NormalEquations:
        linearised = estimate.linearised
        squares = (linearised.residual**2).sum(1)
        information = 1 / (1 + squares / noise**2)
        weight = information / (noise * self.options.correlation) ** 2
        prior, slope = self.errors.prior(estimate.parameters, variances)
        return NormalEquations.of(
            tracks,
            linearised,
            weight,
            prior,
            slope,
        )

    def _moved(
        self,
        tracks: BundleTracks,
        estimate: Estimate,
        solution: Solution,
        root: Array,
    ) -> Estimate:
        before = estimate.parameters
        correction, shared = np.split(solution.change, [6 * self.n])
        rho = before.inverse_depth
        most = MAX_DEPTH_STEP * rho
        rho = rho + solution.depths.clip(-most, most)
        scale = tracks.depth_scale
        parameters = Parameters(
            before.correction + correction.reshape(-1, 6),
            before.shared + shared,
            rho.clip(LEAST_INVERSE_DEPTH / scale, MOST_INVERSE_DEPTH / scale),
        )
        linearised = self.frames.linearise(tracks, parameters)
        return Estimate(parameters, linearised, root, step=solution.length)

    def _pose_variances(self, estimate: Estimate, variances: Variances) -> Variances:
        """Variances of the stated poses, estimated from a step's result."""
        root = estimate.root
        if self.options.common_stated:
            rows = root[:, : 6 * self.n].reshape(-1, self.n, 6)
        else:
            rows = self.errors.of_rows(root)
        posterior = np.einsum("knj,knj->nj", rows, rows)
        errors = self.errors.at_origin(estimate.parameters)
        sigma = pose_sigma(
            errors,
            posterior,
            variances.weight,
            variances.sigma,
            self.options,
        )
        weight = student_weights(errors, sigma, self.options.tail)
        return Variances(sigma, weight, variances.shared)

    def _focal_changes(self, tracks: BundleTracks, estimate: Estimate) -> Array:
        linearised = estimate.linearised
        cameras = self.frames.cameras(estimate.parameters)
        noise = noise_of(linearised) * self.options.correlation
        return focal_changes(tracks, linearised, cameras, noise)

    def _result(
        self,
        tracks: BundleTracks,
        estimate: Estimate,
        variances: Variances,
    ) -> Adjustment:
        n = self.n
        parameters = estimate.parameters
        linearised = estimate.linearised
        residual = np.linalg.solve(tracks.whitening, linearised.residual[..., None])
        residual_px = norms(residual[linearised.valid, :, 0])
        cameras = self.frames.cameras(parameters) if self.adjusts_camera else None
        root = estimate.root
        by_pose = [root[:, 6 * i : 6 * i + 6] for i in range(n)]
        shared = root[:, 6 * n :]
        with_lens = np.r_[:COMMON, -INTRINSICS:0]
        whole = shared[:, with_lens].T @ shared[:, with_lens]
        if len(variances.of_kinds):
            systematic = by_shared(self.errors, root, variances)
            whole = whole - systematic[np.ix_(with_lens, with_lens)]
            systematic = HIDDEN * systematic
        else:
            systematic = systematic_covariance(
                self.frames.stated,
                self.errors,
                parameters,
                root,
                variances,
                self.options.least_systematic,
            )
        joints = self.errors.offsets
        offsets = shared[:, joints].T @ shared[:, joints]
        prior = variances.shared[joints]
        information = np.maximum(1 / np.diag(offsets) - 1 / prior, MIN_INFORMATION)
        first_prior = self.start_variances().shared[joints]
        errors = self.errors.at_origin(parameters)
        noise = self.errors.noise(variances)
        return Adjustment(
            poses=self.frames.poses(parameters),
            cameras=cameras,
            common=_small_motion(parameters.shared[:COMMON]),
            shift_frames=float(parameters.shared[COMMON]),
            sigma_m=float(variances.sigma[0]),
            sigma_rad=float(variances.sigma[3]),
            residual_px=float(np.median(residual_px)),
            lens_covariance=whole,
            lens_systematic=systematic[np.ix_(with_lens, with_lens)],
            correction=self.errors.of_cameras(parameters),
            errors=errors,
            left_out=left_out(errors, self.errors.of_rows(root), noise),
            weight=np.minimum(variances.weight, 1.0),
            covariance=np.stack([columns.T @ columns for columns in by_pose]),
            inverse_depth=parameters.inverse_depth,
            focal_changes=self._focal_changes(tracks, estimate),
            offsets=parameters.shared[joints],
            offsets_covariance=offsets + systematic[joints, joints],
            offsets_prior=np.sqrt(prior),
            offsets_known=1 / information < DETERMINED * first_prior,
        )


def _small_motion(tangent: Array) -> SE3:
    """Transform of a translation (3,) and a rotation vector (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(tangent[3:]).as_matrix()
    matrix[:3, 3] = tangent[:3]
    return SE3.from_matrix(matrix)
