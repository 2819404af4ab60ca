"""Residuals of bundle adjustment, their derivatives, and the normal equations of one step."""

from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import lapack
from scipy.spatial.transform import Rotation

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, cross_matrix
from evercal.typing import Array, ArrayPair, BoolArray, IntArray

COMMON = 6
"""Shared parameters of the common transform."""
SHIFT = 1
"""Shared parameters of the time shift."""
DISTORTION = 5
"""Distortion coefficients that can be adjusted: k1 k2 p1 p2 k3, or k1 k2 k3 k4 of a fisheye."""
INTRINSICS = 3 + DISTORTION
"""Intrinsics: logarithm of the focal length, principal point in pixels, distortion."""
SHARED = COMMON + SHIFT + INTRINSICS
"""Shared parameters in this order. Offsets of an arm's joints come before the intrinsics."""
MIN_DEPTH = 0.05
"""Nearer points are projected as if they were at this depth, in units of `depth_scale`."""
MIN_DEPTH_SUM = 1e-6
"""Added to the information on each inverse depth, so that no division is by zero."""
MIN_DISTORTION = 1e-4
"""Smaller changes of all distortion coefficients are ignored."""


@frozen_arrays
class BundleTracks:
    """Landmarks and their observations."""

    host: IntArray
    """(p,) frame that a landmark's patch belongs to."""
    pixels: Array
    """(p, 2) pixel in the host frame."""
    inverse_depth: Array
    """(p,) per metre."""
    landmark: IntArray
    """(m,) landmark of each observation."""
    frame: IntArray
    """(m,) frame of each observation."""
    observed: Array
    """(m, 2) pixels."""
    whitening: Array
    """(m, 2, 2), see `patches.whitening`."""
    depth_scale: float = 1.0
    """Factor on the usual depths of a room, see `plane_sweep.NEAR_M`."""

    @property
    def host_frame(self) -> IntArray:
        """(m,) host of the landmark of each observation."""
        return self.host[self.landmark]


@frozen_arrays
class Parameters:
    """Everything that bundle adjustment estimates."""

    correction: Array
    """(n, 6) motion of each frame from its stated pose, camera frame, metres and radians."""
    shared: Array
    """(15 + k,) see `SHARED`."""
    inverse_depth: Array
    """(p,) per metre."""


@frozen_arrays
class Linearised:
    """Whitened residuals of m observations and their derivatives.

    All values are 0 for observations that are not `valid`.
    """

    residual: Array
    """(m, 2)."""
    by_host: Array
    """(m, 2, 6) by the correction of the host frame."""
    by_frame: Array
    """(m, 2, 6) by the correction of the observing frame."""
    by_depth: Array
    """(m, 2) by the inverse depth."""
    by_intrinsics: Array
    """(m, 2, 8)."""
    valid: BoolArray
    """(m,) False where the distortion of the camera has no pixel for the landmark."""


class StatedFrames:
    """Stated poses and cameras of n frames, which parameters correct.

    Cameras are those of the image size that observations are given in.
    """

    def __init__(self, stated: SE3, cameras: list[Camera]):
        self.stated = stated
        self._rotation = stated.rotation_matrix()
        self._position = stated.translation_m
        self._cameras = cameras
        lenses = {replace(camera, cx=0.0, cy=0.0) for camera in cameras}
        self.same_lens = len(lenses) == 1

    def __len__(self) -> int:
        return len(self._cameras)

    def poses(self, parameters: Parameters) -> SE3:
        """(n,) corrected base_from_camera."""
        rotation, position = self._corrected(parameters)
        matrix = np.tile(np.eye(4), (len(self), 1, 1))
        matrix[:, :3, :3] = rotation
        matrix[:, :3, 3] = position
        return SE3.from_matrix(matrix)

    def cameras(self, parameters: Parameters) -> list[Camera]:
        """(n,) corrected cameras, where all frames share one lens."""
        change = parameters.shared[-INTRINSICS:]
        if not (self.same_lens and np.any(change)):
            return self._cameras
        distorts = np.abs(change[3:]).max() > MIN_DISTORTION
        corrected = {}
        for camera in set(self._cameras):
            changed = camera.changed(change)
            if not distorts:
                changed = replace(changed, distortion=camera.distortion)
            corrected[camera] = changed
        return [corrected[camera] for camera in self._cameras]

    def linearise(self, tracks: BundleTracks, parameters: Parameters) -> Linearised:
        """Residuals and derivatives at given parameters."""
        rotation, position = self._corrected(parameters)
        k = tracks.host_frame
        j = tracks.frame
        ray, ray_slope = self._rays(tracks, parameters)
        rho = parameters.inverse_depth[tracks.landmark, None]
        frame_from_base = rotation[j].transpose(0, 2, 1)
        frame_from_host = frame_from_base @ rotation[k]
        point = np.einsum("nij,nj->ni", frame_from_host, ray / rho)
        point += np.einsum("nij,nj->ni", frame_from_base, position[k] - position[j])
        point[:, 2] = np.maximum(point[:, 2], MIN_DEPTH * tracks.depth_scale)
        plane = point[:, :2] / point[:, 2:]
        pixel = np.zeros_like(plane)
        by_plane = np.zeros((len(j), 2, 2))
        by_camera = np.zeros((len(j), 2, INTRINSICS))
        for camera, rows in self._by_camera(parameters, j):
            pixel[rows] = camera.project(point[rows])
            by_plane[rows], by_camera[rows] = camera.slopes(plane[rows], DISTORTION)
        to_plane = np.zeros((len(j), 2, 3))
        to_plane[:, 0, 0] = to_plane[:, 1, 1] = 1 / point[:, 2]
        to_plane[:, :, 2] = -plane / point[:, 2:]
        by_point = by_plane @ to_plane
        by_host = by_point @ frame_from_host
        by_ray = by_host[:, :, :2] / rho[..., None]
        white = tracks.whitening
        parts = (
            np.einsum("nij,nj->ni", white, pixel - tracks.observed),
            white @ np.concatenate([by_host, -by_host @ cross_matrix(ray / rho)], 2),
            white @ np.concatenate([-by_point, by_point @ cross_matrix(point)], 2),
            np.einsum(
                "nij,njk,nk->ni",
                white,
                -by_host,
                ray,
            )
            / rho**2,
            white @ (by_camera + by_ray @ ray_slope),
        )
        # The distortion of the current estimate can be too strong for a landmark near the edge.
        valid = np.isfinite(pixel).all(1)
        for part in parts:
            part[~valid] = 0
        return Linearised(*parts, valid)

    def _rays(self, tracks: BundleTracks, parameters: Parameters) -> ArrayPair:
        """Rays (m, 3) of the observed landmarks in their hosts, and derivatives (m, 2, 8)."""
        ray = np.zeros((len(tracks.host), 3))
        slope = np.zeros((len(tracks.host), 2, INTRINSICS))
        for camera, rows in self._by_camera(parameters, tracks.host):
            ray[rows] = camera.unproject(tracks.pixels[rows])
            # A pixel is fixed: its ray moves against the change of the projection.
            by_plane, by_camera = camera.slopes(ray[rows, :2], DISTORTION)
            slope[rows] = -np.linalg.solve(by_plane, by_camera)
        return ray[tracks.landmark], slope[tracks.landmark]

    def _corrected(self, parameters: Parameters) -> ArrayPair:
        """Rotations (n, 3, 3) and positions (n, 3) of the corrected poses."""
        translation, turn = np.split(parameters.correction, 2, axis=1)
        rotation = self._rotation @ Rotation.from_rotvec(turn).as_matrix()
        shift = np.einsum("nij,nj->ni", self._rotation, translation)
        return rotation, self._position + shift

    def _by_camera(
        self, parameters: Parameters, frames: IntArray
    ) -> list[tuple[Camera, IntArray]]:
        cameras = self.cameras(parameters)
        groups = []
        for camera in dict.fromkeys(cameras):
            numbers = [i for i, other in enumerate(cameras) if other == camera]
            groups.append((camera, np.flatnonzero(np.isin(frames, numbers))))
        return groups


@frozen_arrays
class Solution:
    """One step."""

    change: Array
    """(6 n + 15 + k,) of corrections and shared parameters."""
    depths: Array
    """(p,) of the inverse depths."""
    root: Array
    """The covariance of `change` is root.T @ root, if the equations are not damped."""
    length: float
    """Length of the step in standard deviations."""


class HostBlock(NamedTuple):
    """The landmarks of one host frame, and the parameters that their observations depend on."""

    landmarks: IntArray
    """(a,)."""
    columns: IntArray
    """(b,) parameters."""
    mixed: Array
    """(a, b) normal equations between inverse depths and parameters."""


@frozen_arrays
class NormalEquations:
    """Least squares in corrections and shared parameters (6 n + 15 + k) and inverse depths (p)."""

    gram: Array
    """(6 n + 15 + k, 6 n + 15 + k) of the observations."""
    prior: Array
    """(6 n + 15 + k, 6 n + 15 + k) of the priors."""
    blocks: list[HostBlock]
    depth: Array
    """(p,) diagonal of the inverse depths."""
    slope: Array
    """(6 n + 15 + k,) half the gradient of the cost."""
    depth_slope: Array
    """(p,) the same by inverse depths."""

    @classmethod
    def of(
        cls,
        tracks: BundleTracks,
        lin: Linearised,
        weight: Array,
        prior: Array,
        slope: Array,
    ) -> Self:
        """Sum the products of derivatives, weighted (m,), over the observations of each host."""
        root = np.sqrt(weight)[:, None]
        derivatives = np.concatenate([lin.by_host, lin.by_frame, lin.by_intrinsics], 2)
        rows = derivatives * root[..., None]
        residual = lin.residual * root
        by_depth = lin.by_depth * root
        count = len(tracks.host)
        depth = (
            np.bincount(tracks.landmark, (by_depth**2).sum(1), count) + MIN_DEPTH_SUM
        )
        depth_slope = (by_depth * residual).sum(1)
        depth_slope = np.bincount(tracks.landmark, depth_slope, count)
        mixed = np.einsum("mr,mrc->mc", by_depth, rows)
        gram = np.zeros(prior.shape)
        slope = slope.copy()
        six = np.arange(6)
        last = np.arange(len(gram) - INTRINSICS, len(gram))
        blocks = []
        for host in np.unique(tracks.host_frame):
            of_host = np.flatnonzero(tracks.host_frame == host)
            landmarks, place = np.unique(tracks.landmark[of_host], return_inverse=True)
            frames, frame = np.unique(tracks.frame[of_host], return_inverse=True)
            by_frames = (6 * frames[:, None] + six).ravel()
            columns = np.concatenate([6 * host + six, by_frames, last])
            local = np.zeros((len(columns), len(columns)))
            block = np.zeros((len(landmarks), len(columns)))
            for number in range(len(frames)):
                in_frame = frame == number
                observed = of_host[in_frame]
                where = np.r_[0:6, 6 + 6 * number + six, -INTRINSICS:0]
                product = rows[observed].reshape(-1, len(where))
                local[where[:, None], where] += product.T @ product
                slope[columns[where]] += product.T @ residual[observed].ravel()
                # A frame sees a landmark once.
                block[place[in_frame][:, None], where] += mixed[observed]
            gram[columns[:, None], columns] += local
            blocks.append(HostBlock(landmarks, columns, block))
        return cls(
            gram,
            prior,
            blocks,
            depth,
            slope,
            depth_slope.astype(float),
        )

    def solve(self, damping: float) -> Solution | None:
        """Solve with diagonal elements raised by a share; None if not positive definite."""
        depth = (1 + damping) * self.depth
        system = self.gram + self.prior
        slope = self.slope.copy()
        for landmarks, columns, mixed in self.blocks:
            scaled = mixed / depth[landmarks, None]
            system[columns[:, None], columns] -= mixed.T @ scaled
            slope[columns] -= scaled.T @ self.depth_slope[landmarks]
        diagonal = np.arange(len(system))
        system[diagonal, diagonal] += damping * (
            self.gram.diagonal() + self.prior.diagonal()
        )
        try:
            lower = np.linalg.cholesky(system)
        except np.linalg.LinAlgError:
            return None
        root = lapack.dtrtri(lower, lower=1)[0]  # pyright: ignore[reportAttributeAccessIssue]
        whitened = root @ slope
        change = -root.T @ whitened
        depths = -self.depth_slope
        for landmarks, columns, mixed in self.blocks:
            depths[landmarks] -= mixed @ change[columns]
        depths = depths / depth
        if not (np.isfinite(change).all() and np.isfinite(depths).all()):
            return None
        return Solution(
            change,
            depths,
            root,
            float(np.linalg.norm(whitened)),
        )


@frozen_arrays
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
    lens_covariance: Array
    """(14, 14) of the common transform, camera frame, metres and radians, and the intrinsics."""
    lens_systematic: Array
    """(14, 14) of the same, due to errors of stated poses that vary linearly over the recording."""
    correction: Array
    """(n, 6) of each pose beside common transform and time shift, camera frame, metres and
    radians."""
    errors: Array
    """(n, 6) the same where the errors of stated poses arise, see `StatedErrors`."""
    left_out: Array
    """(n, 7) the same by the images and all other poses alone, and the squared Mahalanobis
    distance of which 6 is expected, in a hand-eye calibration; see `left_out`."""
    weight: Array
    """(n,) below 1 for stated poses with larger errors than most."""
    covariance: Array
    """(n, 6, 6) of the adjusted poses, camera frame."""
    inverse_depth: Array
    """(p,) per metre."""
    focal_changes: Array
    """(n, 2) see `changed_lens.focal_changes`."""
    offsets: Array
    """(k,) offsets of the joints of an arm, radians, or metres of sliding joints."""
    offsets_covariance: Array
    """(k, k) with systematic errors."""
    offsets_prior: Array
    """(k,) estimated standard deviation of the offsets of this arm."""
    offsets_known: BoolArray
    """(k,) whether the images tell an offset better than the first prior."""

    @property
    def common_covariance(self) -> Array:
        """(6, 6) of the common transform, camera frame, metres and radians."""
        return self.lens_covariance[:COMMON, :COMMON]

    @property
    def common_systematic(self) -> Array:
        """(6, 6) of the same, due to errors of stated poses that vary linearly."""
        return self.lens_systematic[:COMMON, :COMMON]
