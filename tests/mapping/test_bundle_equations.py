"""Normal equations and derivatives of bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.mapping.bundle_equations import (
    COMMON,
    INTRINSICS,
    SHARED,
    SHIFT,
    BundleTracks,
    Linearised,
    NormalEquations,
    Parameters,
    StatedFrames,
)
from evercal.typing import Array

from .projected_tracks import CAMERA, FRAMES, world

DISTORTIONS = [
    (),
    (-0.1, 0.05, 0.0, 0.0),
    (-0.1, 0.05, 0.004, -0.003),
    (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    (0.1, -0.05, 0.001, -0.002, 0.01, 0.15, 0.01, 0.002),
]


def dense(lin: Linearised, tracks: BundleTracks) -> Array:
    """(2 m, 6 n + 12) derivatives by corrections and shared parameters."""
    jacobian = np.zeros((len(tracks.frame), 2, 6 * FRAMES + SHARED))
    for i, (host, frame) in enumerate(
        zip(tracks.host_frame, tracks.frame, strict=True)
    ):
        jacobian[i, :, 6 * host : 6 * host + 6] = lin.by_host[i]
        jacobian[i, :, 6 * frame : 6 * frame + 6] = lin.by_frame[i]
    jacobian[..., -INTRINSICS:] = lin.by_intrinsics
    return jacobian.reshape(-1, jacobian.shape[2])


def test_normal_equations_are_those_of_the_dense_derivatives() -> None:
    made = world(CAMERA)
    frames = StatedFrames(made.truth, [CAMERA] * FRAMES)
    tracks = made.tracks
    rng = np.random.default_rng(1)
    size = 6 * FRAMES + SHARED
    own = rng.normal(0, 1e-3, (FRAMES, 6))
    shared = np.zeros(SHARED)
    lin = frames.linearise(tracks, Parameters(own, shared, tracks.inverse_depth))
    weight = rng.uniform(0.5, 2, len(tracks.frame))
    solution = NormalEquations.of(
        tracks, lin, weight, np.eye(size), np.zeros(size)
    ).solve(0.1)
    assert solution is not None
    depth = np.zeros((2 * len(tracks.frame), len(tracks.host)))
    depth[np.arange(len(depth)), np.repeat(tracks.landmark, 2)] = lin.by_depth.ravel()
    root = np.sqrt(np.repeat(weight, 2))[:, None]
    whole = np.hstack([dense(lin, tracks), depth]) * root
    slope = lin.residual.ravel() * root[:, 0]
    system = whole.T @ whole + np.diag(
        np.r_[np.ones(size), np.full(depth.shape[1], 1e-6)]
    )
    system += 0.1 * np.diag(np.diag(system))
    step = -np.linalg.solve(system, whole.T @ slope)
    np.testing.assert_allclose(solution.change, step[:size], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(solution.depths, step[size:], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_derivatives_are_finite_differences(distortion: tuple[float, ...]) -> None:
    camera = replace(CAMERA, distortion=distortion)
    made = world(camera)
    frames = StatedFrames(made.truth, [camera] * FRAMES)
    tracks = made.tracks

    def parameters(change: Array, depth: Array) -> Parameters:
        own = change[: 6 * FRAMES].reshape(-1, 6)
        shared = change[6 * FRAMES :]
        return Parameters(own, shared, depth)

    def residual(change: Array, depth: Array = tracks.inverse_depth) -> Array:
        return frames.linearise(tracks, parameters(change, depth)).residual.ravel()

    zero = np.zeros(6 * FRAMES + SHARED)
    lin = frames.linearise(tracks, parameters(zero, tracks.inverse_depth))
    jacobian = dense(lin, tracks)
    rng = np.random.default_rng(0)
    poses = rng.choice(6 * FRAMES, 30, replace=False)
    intrinsics = 6 * FRAMES + COMMON + SHIFT + np.arange(INTRINSICS)
    for column in (*poses.tolist(), *intrinsics.tolist()):
        step = zero.copy()
        # Changes of the distortion below 1e-4 are ignored.
        step[column] = 1e-3 if column >= 6 * FRAMES + SHARED - 5 else 1e-5
        slope = (residual(step) - residual(-step)) / (2 * step[column])
        np.testing.assert_allclose(
            jacobian[:, column], slope, atol=1e-3 * np.abs(slope).max()
        )
    # Common transform and time shift act through the priors alone.
    assert not jacobian[:, 6 * FRAMES : 6 * FRAMES + COMMON + SHIFT].any()
    rho = tracks.inverse_depth
    slope = (residual(zero, rho + 1e-6) - residual(zero, rho - 1e-6)) / 2e-6
    np.testing.assert_allclose(
        lin.by_depth.ravel(), slope, atol=1e-4 * np.abs(slope).max()
    )
