"""Bundle adjustment on tracks that are made by projection: what was put in is found again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3, pose_distance
from evercal.mapping.bundle_adjustment import (
    COMMON,
    GLOBALS,
    LENS,
    SHIFT,
    Adjustment,
    BundleAdjustment,
    BundleOptions,
    BundleTracks,
    _State,
)
from evercal.mapping.jacobians import camera_jacobian
from evercal.simulation.box_room import look_at

Array = NDArray[np.floating]
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
FRAMES = 30
LANDMARKS = 25
"""Of every third frame."""


def path(times: Array) -> SE3:
    """A smooth walk in front of a wall that turns about all axes."""
    poses = []
    for t in times / FRAMES * 2 * np.pi:
        eye = np.array([0.6 * np.sin(t), 0.4 * np.cos(2 * t + 1), 1.4 + 0.3 * np.sin(3 * t)])
        ahead = np.array([0.3 * np.cos(2 * t), 2.5, 0.3 * np.sin(t)])
        poses.append(look_at(eye, eye + ahead, 0.5 * np.sin(t + 2)))
    return SE3.stack(poses)


@dataclass
class World:
    """Tracks, and the poses and the lens that they were made with."""

    truth: SE3
    tracks: BundleTracks
    camera: Camera
    inverse_depth: Array


def world(
    camera: Camera = CAMERA, noise_px: float = 0.2, seed: int = 0, truth: SE3 | None = None
) -> World:
    """Landmarks of every third frame at random depths, seen by all frames that can see them."""
    rng, poses = np.random.default_rng(seed), truth or path(np.arange(float(FRAMES)))
    n = len(poses)
    host = np.repeat(np.arange(0, n, 3), LANDMARKS)
    pixels = rng.uniform([40, 40], [600, 440], (len(host), 2))
    inverse = 1 / rng.uniform(1.5, 4.0, len(host))
    rays = camera.unproject(pixels)
    landmark, frame, observed = [], [], []
    points = np.stack(
        [poses[int(k)].apply(r / d) for k, r, d in zip(host, rays, inverse, strict=True)]
    )
    for j in range(n):
        local = poses[j].inverse().apply(points)
        ahead = local[:, 2] > 0.3
        at = camera.project(np.where(ahead[:, None], local, [0, 0, 1]))
        inside = ahead & (host != j) & (at > 5).all(1) & (at < [634, 474]).all(1)
        which = np.flatnonzero(inside)
        landmark.append(which)
        frame.append(np.full(len(which), j))
        observed.append(at[which] + rng.normal(0, noise_px, (len(which), 2)))
    found = np.concatenate(landmark)
    white = np.tile(np.eye(2) / 0.3, (len(found), 1, 1))
    start = inverse * (1 + rng.normal(0, 0.01, len(inverse)))
    tracks = BundleTracks(
        host, pixels, start, found, np.concatenate(frame), np.concatenate(observed), white
    )
    return World(poses, tracks, camera, inverse)  # fmt: skip


def solved(
    made: World,
    stated: SE3,
    camera: Camera | None = None,
    velocity: Array | None = None,
    options: BundleOptions | None = None,
) -> Adjustment:
    still = np.zeros((len(stated), 6))
    cameras = [camera or made.camera] * len(stated)
    moved = still if velocity is None else velocity
    return BundleAdjustment(stated, cameras, moved, options or BundleOptions()).solve(made.tracks)


def jittered(poses: SE3, sigma_m: float, sigma_rad: float, seed: int = 1) -> SE3:
    noise = np.random.default_rng(seed).normal(size=(len(poses), 6))
    return poses @ SE3.exp(noise * ([sigma_m] * 3 + [sigma_rad] * 3))


def errors(found: SE3, truth: SE3) -> tuple[Array, Array]:
    """Metres and radians of each pose."""
    both = [pose_distance(found[i], truth[i]) for i in range(len(truth))]
    return np.array([m for m, _ in both]), np.array([r for _, r in both])


def without_gauge(found: SE3, truth: SE3) -> SE3:
    """The poses moved as one to where they fit the true ones best."""
    mean = (truth @ found.inverse()).log().mean(0)
    return SE3.exp(mean) @ found


def test_exact_poses_stay_exactly() -> None:
    made = world(noise_px=0.0)
    found = solved(made, made.truth)
    metres, radians = errors(found.poses, made.truth)
    assert metres.max() < 1e-5
    assert radians.max() < 1e-5
    np.testing.assert_allclose(found.inverse_depth, made.inverse_depth, rtol=1e-4)
    assert np.abs(found.common.log()).max() < 1e-6
    assert found.camera is not None
    assert found.camera.fx == pytest.approx(CAMERA.fx, rel=1e-6)
    assert found.residual_px < 1e-3
    assert found.weight.min() > 0.9


def test_noise_of_pixels_alone_moves_no_pose_by_much() -> None:
    made = world()
    found = solved(made, made.truth)
    metres, radians = errors(found.poses, made.truth)
    assert metres.max() < 1e-3
    assert radians.max() < 5e-4
    assert found.sigma_m < 3e-4
    assert found.sigma_rad < 2e-4
    assert found.shift_frames == 0
    # The median length of a residual of two Gaussian axes, less what the fit takes up.
    assert found.residual_px == pytest.approx(0.2 * 1.177, rel=0.1)


@pytest.mark.parametrize(("sigma_m", "sigma_deg"), [(0.005, 0.3), (0.02, 0.1), (0.002, 1.0)])
def test_errors_of_poses_shrink_and_are_estimated(sigma_m: float, sigma_deg: float) -> None:
    made, sigma_rad = world(), np.deg2rad(sigma_deg)
    stated = jittered(made.truth, sigma_m, sigma_rad)
    found = solved(made, stated)
    before = errors(without_gauge(stated, made.truth), made.truth)
    after = errors(without_gauge(found.poses, made.truth), made.truth)
    for a, b in zip(after, before, strict=True):
        assert np.median(a) < np.median(b) / 3
    # Beside what is common to all frames, which is no error of single ones.
    assert found.sigma_m == pytest.approx(sigma_m, rel=0.3)
    assert found.sigma_rad == pytest.approx(sigma_rad, rel=0.3)


def test_a_covariance_is_that_of_many_runs() -> None:
    found, spread = [], []
    for seed in range(6):
        made = world(seed=seed)
        stated = jittered(made.truth, 0.004, 0.004, seed + 100)
        answer = solved(made, stated)
        errors_ = (made.truth.inverse() @ answer.poses).log()
        found.append(errors_)
        spread.append(np.einsum("nii->ni", answer.covariance))
    for part in (slice(0, 3), slice(3, 6)):
        claimed = np.mean([s[:, part] for s in spread])
        true = np.mean([np.square(e[:, part]) for e in found])
        # 0.46 to 0.63 with other noise: three times more or less would be told.
        assert 0.4 < claimed / true < 1.3


def test_what_is_wrong_with_all_poses_is_found() -> None:
    made = world()
    common = SE3.exp(np.array([0.012, -0.008, 0.015, 0.01, -0.015, 0.02]))
    found = solved(made, made.truth @ common.inverse())
    metres, radians = pose_distance(found.common, common)
    assert metres < 1.5e-3
    assert radians < 1e-3
    assert found.sigma_m < 1e-3
    metres, radians = errors(without_gauge(found.poses, made.truth), made.truth)
    assert np.median(metres) < 1e-3
    assert np.median(radians) < 1e-3
    # The poses' own corrections are counted beside it.
    assert np.abs(found.correction[:, :3]).max() < 2e-3


@pytest.mark.parametrize("factor", [1.01, 0.99])
def test_a_wrong_focal_length_is_found(factor: float) -> None:
    made = world()
    wrong = replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy)
    found = solved(made, made.truth, wrong)
    assert found.camera is not None
    assert found.camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)
    assert found.camera.fy == pytest.approx(CAMERA.fy, rel=1e-3)
    metres, _ = errors(found.poses, made.truth)
    assert np.median(metres) < 2e-3
    # It stays where the lens is not to be adjusted, and where frames differ in theirs.
    fixed = solved(made, made.truth, wrong, options=BundleOptions(lens=False))
    assert fixed.camera is None
    several = [wrong, *[CAMERA] * (FRAMES - 1)]
    mixed = BundleAdjustment(made.truth, several, np.zeros((FRAMES, 6)), BundleOptions())
    assert mixed.solve(made.tracks).camera is None


def test_distortion_that_nobody_stated_is_found() -> None:
    bent = replace(CAMERA, distortion=(-0.08, 0.03, 0.0, 0.0))
    made = world(bent)
    found = solved(made, made.truth, CAMERA)
    assert found.camera is not None
    corners = np.array([[30.0, 30], [610, 30], [320, 440], [100, 240], [320, 240]])
    rays, truth = found.camera.unproject(corners), bent.unproject(corners)
    assert np.abs(CAMERA.unproject(corners) - truth).max() > 0.015
    assert np.abs(rays - truth).max() < 2e-3
    # A stated distortion is taken as known.
    kept = solved(made, made.truth, bent)
    assert kept.camera is not None
    np.testing.assert_allclose(kept.camera.distortion, bent.distortion, atol=1e-3)


def velocities(stated: SE3) -> Array:
    steps = (stated[:-1].inverse() @ stated[1:]).log()
    velocity = np.zeros((len(stated), 6))
    velocity[1:-1] = (steps[:-1] + steps[1:]) / 2
    return velocity


@pytest.mark.parametrize("late", [0.4, -0.3, 0.0])
def test_a_shift_in_time_is_found(late: float) -> None:
    times = np.arange(float(FRAMES))
    made = world(truth=path(times + late))
    stated = jittered(path(times), 0.001, 0.0005)
    found = solved(made, stated, velocity=velocities(stated))
    assert found.shift_frames == pytest.approx(late, abs=0.03)
    if late == 0:
        assert abs(found.shift_frames) < 0.005


def test_one_frame_far_off_gets_little_weight() -> None:
    made = world()
    stated = jittered(made.truth, 0.002, 0.001)
    # As far as tracks reach: wrong by more than that, a frame has none (`pose_check`).
    off = SE3.exp(np.array([0.06, -0.03, 0.04, 0.01, 0.02, 0.0]))
    spoilt = SE3.stack([stated[i] @ off if i == 13 else stated[i] for i in range(FRAMES)])
    found = solved(made, spoilt)
    assert found.weight.argmin() == 13
    assert found.weight[13] < 0.1
    assert np.delete(found.weight, 13).min() > 0.25
    metres, _ = errors(without_gauge(found.poses, made.truth), made.truth)
    assert metres[13] < 0.01
    # And the others are no worse for it.
    assert found.sigma_m == pytest.approx(0.002, rel=0.5)
    clean = solved(made, stated)
    assert clean.weight.min() > 0.25


def test_few_wrong_tracks_change_little() -> None:
    made = world()
    rng = np.random.default_rng(3)
    wild = rng.choice(len(made.tracks.frame), len(made.tracks.frame) // 20, replace=False)
    observed = made.tracks.observed.copy()
    observed[wild] += rng.normal(0, 15, (len(wild), 2))
    made.tracks = replace(made.tracks, observed=observed)
    found = solved(made, made.truth)
    metres, _ = errors(found.poses, made.truth)
    assert metres.max() < 2e-3


LENSES = [
    (),
    (-0.1, 0.05, 0.0, 0.0),
    (-0.1, 0.05, 0.004, -0.003),
    (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    (0.1, -0.05, 0.001, -0.002, 0.01, 0.15, 0.01, 0.002),
]


@pytest.mark.parametrize("distortion", LENSES)
def test_derivatives_are_finite_differences(distortion: tuple[float, ...]) -> None:
    camera = replace(CAMERA, distortion=distortion)
    made = world(camera)
    problem = BundleAdjustment(
        made.truth, [camera] * FRAMES, np.zeros((FRAMES, 6)), BundleOptions()
    )
    tracks = made.tracks

    def state(change: Array | None = None, depth: Array | None = None) -> _State:
        full = np.zeros(6 * FRAMES + GLOBALS) if change is None else change
        rho = tracks.inverse_depth if depth is None else depth
        own, shared = full[: 6 * FRAMES].reshape(-1, 6), full[6 * FRAMES :]
        return _State(own, shared, rho, np.ones(6), np.ones(GLOBALS), np.ones(FRAMES))

    def residual(at: _State) -> Array:
        return problem._linearised(tracks, at).residual.ravel()

    lin = problem._linearised(tracks, state())
    jacobian = camera_jacobian(lin, tracks.host[tracks.landmark], tracks.frame, FRAMES).toarray()
    rng = np.random.default_rng(0)
    poses = rng.choice(6 * FRAMES, 30, replace=False)
    lens = 6 * FRAMES + COMMON + SHIFT + np.arange(LENS)
    for column in (*poses.tolist(), *lens.tolist()):
        step = np.zeros(6 * FRAMES + GLOBALS)
        # A distortion below 1e-4 is none.
        step[column] = 1e-3 if column >= 6 * FRAMES + GLOBALS - 2 else 1e-5
        slope = (residual(state(step)) - residual(state(-step))) / (2 * step[column])
        np.testing.assert_allclose(jacobian[:, column], slope, atol=1e-3 * np.abs(slope).max())
    # Common transform and time shift act through the priors alone.
    assert not jacobian[:, 6 * FRAMES : 6 * FRAMES + COMMON + SHIFT].any()
    rho = tracks.inverse_depth
    slope = (residual(state(depth=rho + 1e-6)) - residual(state(depth=rho - 1e-6))) / 2e-6
    np.testing.assert_allclose(lin.depth.ravel(), slope, atol=1e-4 * np.abs(slope).max())


def test_the_same_tracks_give_the_same_answer() -> None:
    made = world()
    stated = jittered(made.truth, 0.004, 0.004)
    one, two = solved(made, stated), solved(made, stated)
    assert np.array_equal(one.poses.matrix(), two.poses.matrix())
    assert one.camera == two.camera
