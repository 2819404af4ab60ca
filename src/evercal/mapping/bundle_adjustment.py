"""Bundle adjustment of a recording: stated poses are measurements, and so is the stated lens.

Unknown are the inverse depth of every landmark, a correction of every frame's pose, one transform
common to all frames (a wrong `gripper_from_camera`), a constant shift in time between poses and
images, and the lens. Everything is tied to what was stated by Gaussian priors whose variances are
estimated from the recording itself (variance components: Foerstner and Wrobel, Photogrammetric
Computer Vision, 2016, section 4.2.4; relevance of single parameters: MacKay, Bayesian
interpolation, 1992). So poses, lens and common transform stay what they were stated to be unless
the images decide otherwise. Landmarks are eliminated by the Schur complement.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.spatial.transform import Rotation

from evercal.geometry import cross_matrix
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.jacobians import (
    COMMON,
    GLOBALS,
    LENS,
    SHIFT,
    Linearised,
    camera_jacobian,
    ray_slopes,
)

Array = NDArray[np.floating]

_GROUPS = ((0, 3), (3, 6), (6, 7), (7, 8), (8, 10), (10, 12))
"""Common translation, common rotation, time shift, focal length, principal point, distortion: what
is judged relevant or not together."""


@dataclass(frozen=True)
class BundleOptions:
    """Priors and weights of a bundle adjustment."""

    iterations: int = 10
    """Gauss-Newton steps."""
    start_sigma_m: float = 0.01
    """Standard deviation of stated positions per axis, metres, before it is estimated."""
    start_sigma_deg: float = 0.4
    """The same of stated rotations, degrees."""
    least_sigma_m: float = 5e-5
    """Stated positions are never taken to be better than this per axis, metres."""
    least_sigma_deg: float = 3e-4
    """The same of stated rotations, degrees."""
    common_sigma_m: float = 0.02
    """Prior standard deviation of the common translation per axis, metres."""
    common_sigma_deg: float = 2.0
    """The same of the common rotation, degrees."""
    common_known: bool = True
    """Keep the common transform at zero unless the images say otherwise. False where nobody stated
    it (a `gripper_from_camera` from nothing): it is then found with its full uncertainty."""
    shift_sigma_frames: float = 2.0
    """Prior standard deviation of the time shift, in frames of the recording."""
    focal_sigma: float = 0.02
    """Prior standard deviation of the focal length as a share of it."""
    centre_sigma_px: float = 5.0
    """Prior standard deviation of the principal point, pixels."""
    distortion_sigma: float = 0.2
    """Prior standard deviation of k1 and k2 where nothing states a distortion."""
    relevance: float = 4.0
    """A group of parameters is adjusted when its squares are this many times their variance."""
    tail: float = 5.0
    """Degrees of freedom of the Student distribution of pose errors: few frames may be far off."""
    correlation: float = 2.0
    """Alignment errors of neighbouring views go together: their deviation is multiplied by this."""
    lens: bool = True
    """Adjust the lens at all."""


@dataclass(frozen=True, eq=False)
class BundleTracks:
    """Landmarks and where they were seen."""

    host: NDArray[np.int64]
    """(p,) frame that a landmark's patch belongs to."""
    pixels: Array
    """(p, 2) its pixel there."""
    inverse_depth: Array
    """(p,) per metre."""
    landmark: NDArray[np.int64]
    """(m,) landmark of each observation."""
    frame: NDArray[np.int64]
    """(m,) frame of each observation."""
    observed: Array
    """(m, 2) pixels."""
    whitening: Array
    """(m, 2, 2), see `patches.whitening`."""
    depth_scale: float = 1.0
    """Of the depths that are possible, see `plane_sweep.NEAR_M`."""


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What bundle adjustment found."""

    poses: SE3
    """(n,) base_from_camera of the frames."""
    camera: Camera | None
    """The lens; None where frames differ in theirs or it is not adjusted."""
    common: SE3
    """stated_camera_from_camera: what all stated poses are to be multiplied with on the right."""
    shift_frames: float
    """The images were taken this many frames after their stated poses."""
    sigma_m: float
    """Estimated standard deviation of stated positions per axis, metres."""
    sigma_rad: float
    """The same of stated rotations."""
    residual_px: float
    """Median reprojection error."""
    common_covariance: Array
    """(6, 6) of the common transform, camera frame, metres and radians."""
    correction: Array
    """(n, 6) of each pose beside the common transform and the shift, camera frame, m and rad."""
    weight: Array
    """(n,) below 1 where a stated pose is further off than most."""
    covariance: Array
    """(n, 6, 6) of the adjusted poses, camera frame."""
    inverse_depth: Array
    """(p,) per metre."""


@dataclass(eq=False)
class _State:
    correction: Array
    shared: Array
    inverse_depth: Array
    sigma: Array
    prior: Array
    weight: Array
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """The covariance of corrections and shared parameters is root.T @ root."""


class BundleAdjustment:
    """The problem of one recording.

    Args:
        stated: (n,) base_from_camera as the recording states them.
        cameras: n lenses at the size patches are cut from; adjusted where all frames share one.
        velocity: (n, 6) motion from frame to frame in the camera frame, m and rad; 0 if unknown.
        options: priors.
    """

    def __init__(
        self,
        stated: SE3,
        cameras: list[Camera],
        velocity: Array,
        options: BundleOptions,
    ):
        self.options, self.n, self.velocity = options, len(stated), velocity
        self._turn, self._place = stated.rotation_matrix(), stated.translation_m
        self._cameras = cameras
        self._alike = options.lens and all(camera == cameras[0] for camera in cameras)

    def solve(self, tracks: BundleTracks) -> Adjustment:
        """Adjusts everything to the tracks."""
        o = self.options
        free = np.full(LENS, 1e-9)
        if self._alike:
            bend = 1e-9 if any(self._cameras[0].distortion) else o.distortion_sigma
            free = np.array([o.focal_sigma, *[o.centre_sigma_px] * 2, bend, bend])
        turn = np.deg2rad(o.common_sigma_deg)
        moves = bool(np.abs(self.velocity).max(initial=0) > 0)
        widest = np.array(
            [*[o.common_sigma_m] * 3, *[turn] * 3, o.shift_sigma_frames if moves else 1e-9, *free]
        )
        start = np.array([*[o.start_sigma_m] * 3, *[np.deg2rad(o.start_sigma_deg)] * 3])
        state = _State(
            np.zeros((self.n, 6)),
            np.zeros(GLOBALS),
            tracks.inverse_depth.copy(),
            start,
            widest**2,
            np.ones(self.n),
        )
        for i in range(o.iterations):
            self._step(tracks, state)
            self._variances(state, widest**2 if i >= 2 else None)
        return self._result(tracks, state)

    def _camera(self, state: _State) -> Camera:
        camera, lens = self._cameras[0], state.shared[COMMON + SHIFT :]
        if not np.any(lens):
            return camera
        bend = np.zeros(max(4, len(camera.distortion)))
        bend[: len(camera.distortion)] = camera.distortion
        bend[:2] += lens[3:]
        grown = np.exp(lens[0])
        return replace(
            camera,
            fx=camera.fx * grown,
            fy=camera.fy * grown,
            cx=camera.cx + lens[1],
            cy=camera.cy + lens[2],
            distortion=tuple(bend) if np.abs(lens[3:]).max() > 1e-4 else camera.distortion,
        )

    def _poses(self, state: _State) -> tuple[Array, Array]:
        own = state.correction
        turn = self._turn @ Rotation.from_rotvec(own[:, 3:]).as_matrix()
        return turn, self._place + np.einsum("nij,nj->ni", self._turn, own[:, :3])

    def _lenses(self, state: _State, frames: NDArray[np.int64]) -> list[tuple[Camera, np.ndarray]]:
        """Cameras with the rows of `frames` that they took."""
        if all(camera == self._cameras[0] for camera in self._cameras):
            return [(self._camera(state), np.arange(len(frames)))]
        groups: dict[Camera, list[int]] = {}
        for i, camera in enumerate(self._cameras):
            groups.setdefault(camera, []).append(i)
        return [(c, np.flatnonzero(np.isin(frames, which))) for c, which in groups.items()]

    def _linearised(self, tracks: BundleTracks, state: _State) -> Linearised:
        turn, place = self._poses(state)
        k, j = tracks.host[tracks.landmark], tracks.frame
        ray, moved = np.zeros((len(tracks.host), 3)), np.zeros((len(tracks.host), 2, LENS))
        for camera, rows in self._lenses(state, tracks.host):
            ray[rows] = camera.unproject(tracks.pixels[rows])
            moved[rows] = ray_slopes(ray[rows], camera)
        ray, moved = ray[tracks.landmark], moved[tracks.landmark]
        rho = state.inverse_depth[tracks.landmark, None]
        back = turn[j].transpose(0, 2, 1)
        across = back @ turn[k]
        seen = np.einsum("nij,nj->ni", across, ray / rho)
        seen += np.einsum("nij,nj->ni", back, place[k] - place[j])
        seen[:, 2] = np.maximum(seen[:, 2], 0.05 * tracks.depth_scale)
        plane = seen[:, :2] / seen[:, 2:]
        at, slope, bent = (
            np.zeros_like(plane),
            np.zeros((len(j), 2, 2)),
            np.zeros((len(j), 2, LENS)),
        )
        for camera, rows in self._lenses(state, j):
            at[rows] = camera.project(seen[rows])
            slope[rows], bent[rows] = camera.slopes(plane[rows])
        to_plane = np.zeros((len(j), 2, 3))
        to_plane[:, 0, 0] = to_plane[:, 1, 1] = 1 / seen[:, 2]
        to_plane[:, :, 2] = -plane / seen[:, 2:]
        by_point = slope @ to_plane
        by_host = by_point @ across
        by_ray = by_host[:, :, :2] / rho[..., None]
        lens = bent + by_ray @ moved
        white = tracks.whitening
        parts = (
            np.einsum("nij,nj->ni", white, at - tracks.observed),
            white @ np.concatenate([by_host, -by_host @ cross_matrix(ray / rho)], 2),
            white @ np.concatenate([-by_point, by_point @ cross_matrix(seen)], 2),
            np.einsum("nij,njk,nk->ni", white, -by_host, ray) / rho**2,
            white @ lens,
        )
        # A lens may come to hold no longer where something was seen: then that says nothing.
        lost = ~np.isfinite(at).all(1)
        for part in parts:
            part[lost] = 0
        return Linearised(*parts)

    def _step(self, tracks: BundleTracks, state: _State) -> None:
        """One Gauss-Newton step; landmarks are eliminated first."""
        lin, n = self._linearised(tracks, state), self.n
        squares = (lin.residual**2).sum(1)
        noise = max(np.sqrt(np.median(squares)) / 1.177, 0.02)
        weight = 1 / (1 + squares / noise**2) / (noise * self.options.correlation) ** 2
        k, j, p = tracks.host[tracks.landmark], tracks.frame, len(tracks.host)
        hold = np.bincount(tracks.landmark, weight * (lin.depth**2).sum(1), p) + 1e-6
        pull = np.bincount(tracks.landmark, weight * (lin.depth * lin.residual).sum(1), p)
        jacobian = camera_jacobian(lin, k, j, n)
        root = np.repeat(np.sqrt(weight), 2)
        scaled = sparse.diags_array(root) @ jacobian
        rows = np.arange(2 * len(j))
        depth = sparse.csr_array(
            ((lin.depth * np.sqrt(weight)[:, None]).ravel(), (rows, np.repeat(tracks.landmark, 2))),
            shape=(2 * len(j), p),
        )
        mixed = (depth.T @ scaled).tocsr()
        gram = sparse.csr_array(scaled.T @ scaled)
        eliminated = sparse.csr_array(mixed.T @ sparse.diags_array(1 / hold) @ mixed)
        system = (gram - eliminated).toarray()
        slope = scaled.T @ (lin.residual.ravel() * root) - mixed.T @ (pull / hold)
        self._add_priors(system, slope, state)
        lower = np.linalg.cholesky(system)
        state.root = lapack.dtrtri(lower, lower=1)[0]  # pyright: ignore[reportAttributeAccessIssue]
        change = -state.root.T @ (state.root @ slope)
        depths = (-pull - mixed @ change) / hold
        rho = state.inverse_depth
        scale = tracks.depth_scale
        state.inverse_depth = (rho + depths.clip(-0.2 * rho, 0.2 * rho)).clip(
            0.03 / scale, 6 / scale
        )
        state.correction = state.correction + change[: 6 * n].reshape(n, 6)
        state.shared = state.shared + change[6 * n :]

    def _deviation(self, state: _State) -> Array:
        """(n, 6) of each correction from what common transform and time shift explain."""
        moved = state.shared[COMMON] * self.velocity
        return state.correction - state.shared[:COMMON] - moved

    def _add_priors(self, system: Array, slope: Array, state: _State) -> None:
        n = self.n
        hold = state.weight[:, None] / state.sigma**2
        off = self._deviation(state)
        own = np.arange(6 * n)
        system[own, own] += hold.ravel()
        slope[own] += (hold * off).ravel()
        axis = np.tile(np.arange(6), n)
        common, shift = 6 * n + axis, 6 * n + COMMON
        np.add.at(system, (own, common), -hold.ravel())
        np.add.at(system, (common, own), -hold.ravel())
        drift = hold * self.velocity
        system[own, shift] -= drift.ravel()
        system[shift, own] -= drift.ravel()
        six = 6 * n + np.arange(6)
        system[six, six] += hold.sum(0)
        system[six, shift] += drift.sum(0)
        system[shift, six] += drift.sum(0)
        system[shift, shift] += (drift * self.velocity).sum()
        slope[six] -= (hold * off).sum(0)
        slope[shift] -= (drift * off).sum()
        last = 6 * n + np.arange(GLOBALS)
        system[last, last] += 1 / state.prior
        slope[last] += state.shared / state.prior

    def _variances(self, state: _State, widest: Array | None) -> None:
        """Estimates the variances of all priors from what the last step left.

        A correction d is the share K of what the images say, y = d / K, and y has the variance
        s^2 + v / K with v the posterior one; so s^2 is the mean of d^2 - v K over that of K^2.
        """
        n, variance = self.n, np.einsum("ij,ij->j", state.root, state.root)
        own = variance[: 6 * n].reshape(n, 6)
        off, weight = self._deviation(state), state.weight[:, None]
        share = 1 - np.minimum(own * weight / state.sigma**2, 1)
        sigma = state.sigma.copy()
        for part in (slice(0, 3), slice(3, 6)):
            old, k = state.sigma[part], share[:, part]
            if k.mean() < 0.03:  # the images cannot tell errors as small as this
                sigma[part] = old / 1.5
                continue
            total = (weight * (off[:, part] ** 2 - own[:, part] * k)).sum()
            sigma[part] = np.sqrt(max(total, 0.0) / (k**2).sum()).clip(old / 3, old * 2)
        least = [self.options.least_sigma_m] * 3 + [np.deg2rad(self.options.least_sigma_deg)] * 3
        state.sigma = sigma.clip(least, 0.1)
        tail = self.options.tail
        state.weight = (tail + 6) / (tail + ((off / state.sigma) ** 2).sum(1))
        if widest is not None:
            self._relevance(state, variance[6 * n :], widest)

    def _relevance(self, state: _State, variance: Array, widest: Array) -> None:
        share = np.maximum(1 - np.minimum(variance / state.prior, 1), 1e-3)
        squares, noise = (state.shared / share) ** 2, variance / share
        for low, high in _GROUPS if self.options.common_known else _GROUPS[2:]:
            part = slice(low, high)
            clear = (squares[part] / noise[part]).mean() > self.options.relevance
            wanted = (squares[part] - noise[part]).mean() if clear else 0.0
            wide = np.clip(wanted, state.prior[part] / 16, widest[part])
            state.prior[part] = np.maximum(wide, 1e-6 * widest[part])

    def _result(self, tracks: BundleTracks, state: _State) -> Adjustment:
        lin, n = self._linearised(tracks, state), self.n
        unwhitened = np.linalg.solve(tracks.whitening, lin.residual[..., None])[..., 0]
        turn, place = self._poses(state)
        matrix = np.tile(np.eye(4), (n, 1, 1))
        matrix[:, :3, :3], matrix[:, :3, 3] = turn, place
        root = [state.root[:, 6 * i : 6 * i + 6] for i in range(n + 1)]
        return Adjustment(
            SE3.from_matrix(matrix),
            self._camera(state) if self._alike else None,
            _small_motion(state.shared[:COMMON]),
            float(state.shared[COMMON]),
            float(state.sigma[0]),
            float(state.sigma[3]),
            float(np.median(np.linalg.norm(unwhitened, axis=1))),
            root[n].T @ root[n],
            self._deviation(state),
            np.minimum(state.weight, 1.0),
            np.stack([columns.T @ columns for columns in root[:n]]),
            state.inverse_depth,
        )


def _small_motion(six: Array) -> SE3:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(six[3:]).as_matrix(), six[:3]
    return SE3.from_matrix(matrix)
