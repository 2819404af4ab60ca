"""Bundle adjustment of a recording whose poses and intrinsics are measurements.

Unknown are the inverse depth of every landmark, a correction of every frame's pose, one transform
common to all frames (an error of `gripper_from_camera`), a constant time shift between poses and
images, and the intrinsics. Where joint values of an arm are stated, so are their offsets. Gaussian
priors tie them to the stated values. The variances of the priors are estimated from the recording
(variance components: Foerstner and Wrobel, Photogrammetric Computer Vision, 2016, section 4.2.4;
relevance of single parameters: MacKay, Bayesian interpolation, 1992). So parameters that the images
do not constrain keep their stated values.

The steps are Levenberg-Marquardt. Landmarks are eliminated by the Schur complement, which leaves
dense normal equations with six rows a frame: 8 (6 n + 12)^2 bytes, and time in proportion to n^3.
`MapOptions.support_frames` bounds n; 350 frames take 36 MB.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.mapping.bundle_equations import (
    COMMON,
    INTRINSICS,
    SHARED,
    SHIFT,
    BundleTracks,
    Linearised,
    NormalEquations,
    Parameters,
    Solution,
    StatedFrames,
)
from evercal.typing import Array, BoolArray

_GROUPS = ((0, 3), (3, 6), (6, 7), (-5, -4), (-4, -2), (-2, None))
"""Shared parameters that are relevant or not together: common translation, common rotation, time
shift, focal length, principal point, distortion."""
MIN_NOISE = 0.02
"""Residuals are never taken to be smaller than this, in their own standard deviations."""
INVALID_SQUARES = 1e8
"""Squared residual that an observation without a projection counts with."""
FIRST_DAMPING, MAX_RAISES = 1e-4, 8
"""Levenberg-Marquardt damping after the first rejected step, and rejections in a row at most."""
ROUNDING = 1e-9
"""Share by which rounding may raise the cost of an accepted step."""
SYSTEMATIC, HIDDEN = (1.0, 1.0), 4.0
"""Prior of the variance of systematic errors: its weight in observed directions, and its size in
variances of the noise. Directions that the images hide vary by this factor more: a real arm that
orbits one place moves its mount by 19 mm along the axis (research/trust.md)."""
DETERMINED = 0.05
"""Variance of a joint offset by the images alone, as a share of its first prior."""
USUAL_OFFSET = 0.05 / 3
"""Offset of a joint of a good arm, in `BundleOptions.joint_sigma_deg`; it weighs as one joint."""
CONVERGED = 1e-9
"""Adjustment ends when a step is this small, in standard deviations, and variances change by less
than this share."""


@dataclass(frozen=True)
class BundleOptions:
    """Priors and weights of a bundle adjustment."""

    iterations: int = 10
    """Steps, at most."""
    start_sigma_m: float = 0.01
    """Standard deviation of stated positions per axis, metres, before it is estimated."""
    start_sigma_deg: float = 0.4
    """The same for stated rotations, degrees."""
    least_sigma_m: float = 5e-5
    """Lower bound of the estimated standard deviation of positions per axis, metres."""
    least_sigma_deg: float = 3e-4
    """The same for rotations, degrees."""
    common_sigma_m: float = 0.02
    """Prior standard deviation of the common translation per axis, metres."""
    common_sigma_deg: float = 2.0
    """The same for the common rotation, degrees."""
    common_stated: bool = True
    """The common transform stays zero unless the images contradict. False for a rough
    `gripper_from_camera`: the common transform is estimated with its full uncertainty."""
    joint_sigma_deg: float = 3.0
    """Prior standard deviation of the offset of a joint, degrees, before it is estimated."""
    joint_sigma_m: float = 0.01
    """The same for sliding joints, metres."""
    shift_sigma_frames: float = 2.0
    """Prior standard deviation of the time shift, in frames of the recording."""
    focal_sigma: float = 0.02
    """Prior standard deviation of the focal length, as a share of it."""
    centre_sigma_px: float = 5.0
    """Prior standard deviation of the principal point, pixels."""
    distortion_sigma: float = 0.2
    """Prior standard deviation of k1 and k2 where the recording states no distortion."""
    relevance: float = 4.0
    """A group of parameters is adjusted when its squares are this many times their variance."""
    least_share: float = 1e-6
    """Variance that a group keeps where the images require no change, as a share of its prior."""
    least_systematic: float = 0.1
    """Least variance of systematic errors of an arm, in variances of the noise."""
    tail: float = 5.0
    """Degrees of freedom of the Student distribution of pose errors; a few frames may be far
    off."""
    correlation: float = 2.0
    """Factor on the standard deviation of observations: alignment errors of neighbouring views are
    correlated."""
    intrinsics: bool = True
    """Adjust the intrinsics."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Result of bundle adjustment."""

    poses: SE3
    """(n,) base_from_camera of the frames."""
    cameras: list[Camera] | None
    """(n,) adjusted intrinsics; None where lenses differ or nothing was adjusted."""
    common: SE3
    """stated_camera_from_camera: stated poses are corrected by this on the right."""
    shift_frames: float
    """Delay of the images after their stated poses, in frames."""
    sigma_m: float
    """Estimated standard deviation of stated positions per axis, metres."""
    sigma_rad: float
    """The same for stated rotations, radians."""
    residual_px: float
    """Median reprojection error, pixels."""
    common_covariance: Array
    """(6, 6) of the common transform, camera frame, metres and radians."""
    common_by_lens: Array
    """(6, 6) part of it that known intrinsics would take away."""
    common_systematic: Array
    """(6, 6) of the same, due to errors of stated poses that vary linearly over the recording."""
    correction: Array
    """(n, 6) of each pose beside common transform and time shift, camera frame, metres and
    radians."""
    errors: Array
    """(n, 6) the same where the errors of stated poses arise, see `BundleAdjustment`."""
    weight: Array
    """(n,) below 1 for stated poses with larger errors than most."""
    covariance: Array
    """(n, 6, 6) of the adjusted poses, camera frame."""
    inverse_depth: Array
    """(p,) per metre."""
    offsets: Array
    """(k,) offsets of the joints of an arm, radians, or metres of sliding joints."""
    offsets_covariance: Array
    """(k, k) with systematic errors."""
    offsets_prior: Array
    """(k,) estimated standard deviation of the offsets of this arm."""
    offsets_known: BoolArray
    """(k,) whether the images tell an offset better than the first prior."""


class JointSlopes(NamedTuple):
    """How joints of an arm move the gripper, in n frames."""

    slopes: Array
    """(n, 6, k) see `Arm.slopes`."""
    rotates: BoolArray
    """(k,) whether a value is an angle."""
    at: Array
    """(k,) offsets that the stated poses contain."""


@dataclass(frozen=True, eq=False)
class Variances:
    """Priors of a bundle adjustment."""

    sigma: Array
    """(6,) standard deviation of stated poses, metres and radians."""
    weight: Array
    """(n,) weights of the stated poses."""
    shared: Array
    """(12 + k,) variances of the shared parameters."""

    def close_to(self, other: "Variances") -> bool:
        """Whether two priors are the same in all digits that matter."""
        return all(
            np.allclose(values, vars(other)[name], rtol=CONVERGED, atol=0)
            for name, values in vars(self).items()
        )


@dataclass(frozen=True, eq=False)
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
    The velocity (n, 6) is the motion from frame to frame, camera frame, metres and radians; 0 if
    unknown. With `gripper_from_camera` (n,), the errors of stated poses are those of an arm: they
    arise at the gripper, and its rotation moves the camera on a lever. With `joints`, offsets of
    its joints are estimated.
    """

    def __init__(
        self,
        stated: SE3,
        cameras: list[Camera],
        velocity: Array,
        options: BundleOptions,
        gripper_from_camera: SE3 | None = None,
        joints: JointSlopes | None = None,
    ):
        self.options = options
        self.n = len(stated)
        self.velocity = velocity
        at = (
            SE3.identity((len(stated),))
            if gripper_from_camera is None
            else gripper_from_camera
        )
        self.gripper_from_camera = at
        self.lever = at.adjoint()
        none = np.zeros((self.n, 6, 0))
        self.joints = joints or JointSlopes(none, np.zeros(0, dtype=bool), np.zeros(0))
        own = np.linalg.solve(self.lever, self.joints.slopes)
        still = np.tile(np.eye(6), (self.n, 1, 1))
        self.motion = np.concatenate([still, velocity[..., None], own], axis=2)
        """(n, 6, 7 + k) motion of each camera by common transform, time shift and joints."""
        self.size = SHARED + own.shape[2]
        last = self.size - INTRINSICS
        self.moving = slice(0, last)
        self.offsets = slice(COMMON + SHIFT, last)
        self.frames = StatedFrames(stated, cameras)
        self.distorted = any(cameras[0].distortion)

    def solve(self, tracks: BundleTracks) -> Adjustment:
        """Estimate all parameters."""
        widest = self.start_variances()
        estimate = self.start(tracks)
        variances = widest
        for i in range(self.options.iterations):
            estimate = self.step(tracks, estimate, variances)
            before = variances
            variances = self._estimated(estimate, variances, widest if i >= 2 else None)
            if estimate.step < CONVERGED and variances.close_to(before):
                break
        return self._result(tracks, estimate, variances)

    def start(self, tracks: BundleTracks) -> Estimate:
        """The stated values."""
        shared = np.zeros(self.size)
        shared[self.offsets] = self.joints.at
        parameters = Parameters(np.zeros((self.n, 6)), shared, tracks.inverse_depth)
        return Estimate(
            parameters, self.frames.linearise(tracks, parameters), np.zeros((0, 0))
        )

    def start_variances(self) -> Variances:
        """Priors before they are estimated."""
        o = self.options
        intrinsics = np.full(INTRINSICS, 1e-9)
        if self.adjusts_camera:
            distortion = 1e-9 if self.distorted else o.distortion_sigma
            intrinsics[:] = (
                o.focal_sigma,
                o.centre_sigma_px,
                o.centre_sigma_px,
                *[distortion] * 2,
            )
        moves = bool(np.abs(self.velocity).max(initial=0) > 0)
        common = [*[o.common_sigma_m] * 3, *[np.deg2rad(o.common_sigma_deg)] * 3]
        shift = o.shift_sigma_frames if moves else 1e-9
        return Variances(
            sigma=np.array(
                [*[o.start_sigma_m] * 3, *[np.deg2rad(o.start_sigma_deg)] * 3]
            ),
            weight=np.ones(self.n),
            shared=np.array([*common, shift, *self._joint_sigma(), *intrinsics]) ** 2,
        )

    def _joint_sigma(self) -> Array:
        turns = np.deg2rad(self.options.joint_sigma_deg)
        return np.where(self.joints.rotates, turns, self.options.joint_sigma_m)

    @property
    def adjusts_camera(self) -> bool:
        """Whether intrinsics are adjusted."""
        return self.options.intrinsics and self.frames.same_lens

    def step(
        self, tracks: BundleTracks, estimate: Estimate, variances: Variances
    ) -> Estimate:
        """One Levenberg-Marquardt step at fixed variances.

        A step that raises the cost is rejected, and the damping is multiplied by 10. The first
        damping is 0: then the step is that of Gauss and Newton.
        """
        noise = noise_of(estimate.linearised)
        normal = self._normal_equations(tracks, estimate, variances, noise)
        cost = self.cost(estimate.linearised, estimate.parameters, variances, noise)
        undamped = normal.solve(0.0)
        damping = estimate.damping
        # The damping of a step does not make its parameters more certain.
        root = None if undamped is None else undamped.root
        for _ in range(MAX_RAISES + 1):
            solution = normal.solve(damping) if damping else undamped
            if solution is not None:
                root = solution.root if root is None else root
                parameters = self._moved(tracks, estimate.parameters, solution)
                linearised = self.frames.linearise(tracks, parameters)
                if self.cost(linearised, parameters, variances, noise) <= cost * (
                    1 + ROUNDING
                ):
                    eased = damping / 10 if damping > FIRST_DAMPING else 0.0
                    return Estimate(
                        parameters, linearised, root, eased, solution.length
                    )
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
        linearised: Linearised,
        parameters: Parameters,
        variances: Variances,
        noise: float,
    ) -> float:
        """Twice the negative logarithm of the posterior: Cauchy residuals and Gaussian priors."""
        squares = (linearised.residual**2).sum(1)
        squares[~linearised.valid] = INVALID_SQUARES
        data = np.log1p(squares / noise**2).sum() / self.options.correlation**2
        own = (
            variances.weight[:, None]
            * (self._errors(parameters) / variances.sigma) ** 2
        )
        return float(data + own.sum() + (parameters.shared**2 / variances.shared).sum())

    def _normal_equations(
        self,
        tracks: BundleTracks,
        estimate: Estimate,
        variances: Variances,
        noise: float,
    ) -> NormalEquations:
        lin = estimate.linearised
        squares = (lin.residual**2).sum(1)
        weight = 1 / (1 + squares / noise**2) / (noise * self.options.correlation) ** 2
        prior, slope = self._prior(estimate.parameters, variances)
        return NormalEquations.of(tracks, lin, weight, prior, slope)

    def _moved(
        self, tracks: BundleTracks, parameters: Parameters, solution: Solution
    ) -> Parameters:
        correction, shared = np.split(solution.change, [6 * self.n])
        rho = parameters.inverse_depth
        scale = tracks.depth_scale
        return Parameters(
            parameters.correction + correction.reshape(-1, 6),
            parameters.shared + shared,
            (rho + solution.depths.clip(-0.2 * rho, 0.2 * rho)).clip(
                0.03 / scale, 6 / scale
            ),
        )

    def _deviation(self, parameters: Parameters) -> Array:
        """(n, 6) of each correction from what the shared parameters explain."""
        moved = parameters.shared[self.moving].copy()
        moved[self.offsets] -= self.joints.at
        return parameters.correction - self.motion @ moved

    def _errors(self, parameters: Parameters) -> Array:
        """(n, 6) the same where the errors arise: at the gripper, or at the camera."""
        return np.einsum("nij,nj->ni", self.lever, self._deviation(parameters))

    def _precision(self, variances: Variances) -> Array:
        """(n, 6, 6) information on each deviation."""
        scaled = (
            self.lever * variances.weight[:, None, None] / variances.sigma[:, None] ** 2
        )
        return self.lever.transpose(0, 2, 1) @ scaled

    def _prior(
        self, parameters: Parameters, variances: Variances
    ) -> tuple[Array, Array]:
        """Normal matrix of the priors, and their slope."""
        n = self.n
        system = np.zeros((6 * n + self.size,) * 2)
        slope = np.zeros(6 * n + self.size)
        precision = self._precision(variances)
        shared = 6 * n + np.arange(self.motion.shape[2])
        pull = np.einsum("nij,nj->ni", precision, self._deviation(parameters))
        drift = precision @ self.motion
        for i, own in enumerate(np.arange(6 * n).reshape(n, 6)):
            system[np.ix_(own, own)] = precision[i]
            system[np.ix_(own, shared)] = -drift[i]
            system[np.ix_(shared, own)] = -drift[i].T
        system[np.ix_(shared, shared)] = np.einsum("nij,nik->jk", self.motion, drift)
        slope[: 6 * n] = pull.ravel()
        slope[shared] = -np.einsum("nij,ni->j", self.motion, pull)
        last = 6 * n + np.arange(self.size)
        system[last, last] += 1 / variances.shared
        slope[last] += parameters.shared / variances.shared
        return system, slope

    def _estimated(
        self, estimate: Estimate, variances: Variances, widest: Variances | None
    ) -> Variances:
        """Variances of all priors, estimated from a step's result.

        A correction d is a share K of what the images say, y = d / K, and y has the variance
        s^2 + v / K with the posterior variance v. So s^2 is the mean of d^2 - v K over that of K^2.
        """
        root = estimate.root
        n = self.n
        own = root[:, : 6 * n].reshape(-1, n, 6)
        own = own if self.options.common_stated else self._error_root(root)
        own = np.einsum("knj,knj->nj", own, own)
        off = self._errors(estimate.parameters)
        weight = variances.weight[:, None]
        share = 1 - np.minimum(own * weight / variances.sigma**2, 1)
        sigma = variances.sigma.copy()
        for part in (slice(0, 3), slice(3, 6)):
            old = variances.sigma[part]
            k = share[:, part]
            if k.mean() < 0.03:  # errors this small are below what the images resolve
                sigma[part] = old / 1.5
                continue
            total = (weight * (off[:, part] ** 2 - own[:, part] * k)).sum()
            sigma[part] = np.sqrt(max(total, 0.0) / (k**2).sum()).clip(old / 3, old * 2)
        least = [self.options.least_sigma_m] * 3 + [
            np.deg2rad(self.options.least_sigma_deg)
        ] * 3
        sigma = sigma.clip(least, 0.1)
        tail = self.options.tail
        shared = variances.shared
        if widest is not None:
            after = np.einsum("ij,ij->j", root[:, 6 * n :], root[:, 6 * n :])
            shared = self._relevant(
                estimate.parameters.shared, shared, after, widest.shared
            )
        return Variances(
            sigma, (tail + 6) / (tail + ((off / sigma) ** 2).sum(1)), shared
        )

    def _relevant(
        self, values: Array, prior: Array, posterior: Array, widest: Array
    ) -> Array:
        share = np.maximum(1 - np.minimum(posterior / prior, 1), 1e-3)
        squares = (values / share) ** 2
        noise = posterior / share
        variances = prior.copy()
        for low, high in _GROUPS if self.options.common_stated else _GROUPS[2:]:
            part = slice(low, high)
            clear = (squares[part] / noise[part]).mean() > self.options.relevance
            wanted = (squares[part] - noise[part]).mean() if clear else 0.0
            wide = np.clip(wanted, prior[part] / 16, widest[part])
            variances[part] = np.maximum(wide, self.options.least_share * widest[part])
        if (part := self.offsets).stop > part.start:
            # One size for all joints: one that no image shows is as far off as the others.
            seen = (1 - posterior[part] / prior[part]).clip(0).sum()
            squares = float((values[part] ** 2 / widest[part]).sum()) + USUAL_OFFSET**2
            size = min(squares / (seen + 1), 1.0)
            variances[part] = (
                max(size, float((prior[part] / widest[part])[0]) / 16) * widest[part]
            )
        return variances

    def _result(
        self, tracks: BundleTracks, estimate: Estimate, variances: Variances
    ) -> Adjustment:
        n = self.n
        parameters = estimate.parameters
        lin = estimate.linearised
        residual = np.linalg.solve(tracks.whitening, lin.residual[..., None])[
            lin.valid, :, 0
        ]
        root = [estimate.root[:, 6 * i : 6 * i + 6] for i in range(n + 1)]
        systematic = self._systematic(estimate, variances)
        joints = self.offsets
        moved = estimate.root[:, 6 * n :][:, joints]
        information = 1 / np.diag(moved.T @ moved) - 1 / variances.shared[joints]
        by_images = 1 / np.maximum(information, 1e-9)
        return Adjustment(
            poses=self.frames.poses(parameters),
            cameras=self.frames.cameras(parameters) if self.adjusts_camera else None,
            common=_small_motion(parameters.shared[:COMMON]),
            shift_frames=float(parameters.shared[COMMON]),
            sigma_m=float(variances.sigma[0]),
            sigma_rad=float(variances.sigma[3]),
            residual_px=float(np.median(np.linalg.norm(residual, axis=1))),
            common_covariance=root[n].T @ root[n],
            common_by_lens=self._by_lens(estimate.root),
            common_systematic=systematic[:COMMON, :COMMON],
            correction=self._deviation(parameters),
            errors=self._errors(parameters),
            weight=np.minimum(variances.weight, 1.0),
            covariance=np.stack([columns.T @ columns for columns in root[:n]]),
            inverse_depth=parameters.inverse_depth,
            offsets=parameters.shared[joints],
            offsets_covariance=moved.T @ moved + systematic[joints, joints],
            offsets_prior=np.sqrt(variances.shared[joints]),
            offsets_known=by_images
            < DETERMINED * self.start_variances().shared[joints],
        )

    def _by_lens(self, root: Array) -> Array:
        common = root[:, 6 * self.n : 6 * self.n + 6]
        lens = root[:, -INTRINSICS:]
        return common.T @ lens @ np.linalg.solve(lens.T @ lens, lens.T @ common)

    def _systematic(self, estimate: Estimate, variances: Variances) -> Array:
        """Covariance of common transform, time shift and joints by systematic errors of poses.

        The errors of a robot's joints vary slowly with the pose. They are modelled by errors that
        are linear in the rotation and position of a frame. Their variance is estimated from the
        residuals, as that of independent errors is: an error in a unit direction that the images
        see to a share K leaves a residual with the variance K^2 t^2 + K s^2.
        """
        n = self.n
        stated = self.frames.stated
        rotations = stated.rotation
        turns = (rotations.mean().inv() * rotations).as_rotvec()
        # Of a fixed camera the frame of the map is the gripper: the arm's position is inverse.
        arm = self.gripper_from_camera.inverse().translation_m
        linear = np.concatenate([turns, stated.translation_m, arm], axis=1)
        basis, size, _ = np.linalg.svd(linear - linear.mean(0), full_matrices=False)
        basis = basis[:, size > 1e-6 * size[0]]
        weight = np.sqrt(variances.weight)[:, None, None]
        posterior = np.einsum(
            "nr,kni->kri", basis, weight[:, 0] * self._error_root(estimate.root)
        )
        residual = (
            basis.T
            @ (weight[:, 0] * self._errors(estimate.parameters))
            / variances.sigma
        )
        share = (1 - ((posterior / variances.sigma) ** 2).sum(0)).clip(0)
        ratio = np.zeros(6)
        for part in (slice(0, 3), slice(3, 6)):
            k = share[:, part]
            excess = (residual[:, part] ** 2 - k).sum() + SYSTEMATIC[0] * SYSTEMATIC[1]
            estimated = excess / ((k**2).sum() + SYSTEMATIC[0])
            ratio[part] = max(estimated, self.options.least_systematic)
        shared = estimate.root[:, 6 * n :][:, self.moving].T @ estimate.root
        # Response of the shared parameters to an error of each stated pose: (7 + k, n, 6).
        own = weight[:, 0] * self._error_root(shared) / variances.sigma
        response = np.einsum("kni,nr->kri", own, basis) * np.sqrt(HIDDEN * ratio)
        rows = response.reshape(len(response), -1)
        return rows @ rows.T

    def _error_root(self, root: Array) -> Array:
        """(k, n, 6) errors of stated poses by rows (k, 6 n + 12 + k) of all parameters.

        Of the factor of their covariance, that of the errors.
        """
        n = self.n
        moved = np.einsum("nij,kj->kni", self.motion, root[:, 6 * n :][:, self.moving])
        own = root[:, : 6 * n].reshape(-1, n, 6) - moved
        return np.einsum("nij,knj->kni", self.lever, own)


def noise_of(linearised: Linearised) -> float:
    """Robust standard deviation of whitened residuals per axis."""
    squares = (linearised.residual[linearised.valid] ** 2).sum(1)
    if not len(squares):
        return MIN_NOISE
    # The median length of two Gaussian axes is 1.177 standard deviations.
    return max(float(np.sqrt(np.median(squares))) / 1.177, MIN_NOISE)


def _small_motion(tangent: Array) -> SE3:
    """Transform of a translation (3,) and a rotation vector (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(tangent[3:]).as_matrix()
    matrix[:3, 3] = tangent[:3]
    return SE3.from_matrix(matrix)
