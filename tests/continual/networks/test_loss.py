"""The reprojection loss against the camera model and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.networks.loss import (
    LossOptions,
    Target,
    clamp_px,
    reprojection_error,
    reprojection_loss,
    surface_loss,
)
from evercal.geometry import SE3, Camera

OPTIONS = LossOptions()
ACE = LossOptions(schedule="circle", clamp_start_px=50.0, clamp_end_px=1.0)
CAMERA = Camera(320, 240, 262.0, 255.0, 158.0, 121.0)
TAU = 7.0


def target(pixels: np.ndarray, poses: SE3, camera: Camera = CAMERA) -> Target:
    count = len(pixels)
    intrinsics = np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (count, 1))
    matrix = poses.inverse().matrix()[:, :3]
    return Target(*(torch.from_numpy(x).float() for x in (pixels, intrinsics, matrix)))


def scattered(seed: int, count: int = 200) -> tuple[SE3, np.ndarray, np.ndarray]:
    """Draw camera poses, points in the camera frames, and the same points in the atlas."""
    rng = np.random.default_rng(seed)
    poses = SE3.exp(rng.uniform(-1, 1, (count, 6)) * [5, 5, 1, 2, 2, 2])
    in_camera = rng.uniform([-0.6, -0.45, 0.5], [0.6, 0.45, 6.0], (count, 3))
    in_camera[:, :2] *= in_camera[:, 2:]
    return poses, in_camera, poses.apply(in_camera)


def straight(
    in_camera: list[list[float]], pixels: list[list[float]]
) -> tuple[Tensor, Target]:
    """Create points and targets of a camera at the origin of the atlas."""
    poses = SE3.identity((len(pixels),))
    return torch.tensor(in_camera), target(np.array(pixels), poses)


def test_error_matches_the_camera_model() -> None:
    poses, in_camera, atlas = scattered(0)
    pixels = np.random.default_rng(1).uniform(0, 320, (200, 2))
    residual, actual = reprojection_error(
        torch.from_numpy(atlas).float(), target(pixels, poses)
    )
    np.testing.assert_allclose(actual.numpy(), in_camera, atol=1e-4)
    np.testing.assert_allclose(
        residual.numpy(), CAMERA.project(in_camera) - pixels, atol=2e-2
    )


def test_circle_schedule_falls_from_51_to_1() -> None:
    for progress, tau in [
        (0.0, 51.0),
        (0.6, 41.0),
        (0.8, 31.0),
        (0.96, 15.0),
        (1.0, 1.0),
    ]:
        assert clamp_px(ACE, progress) == pytest.approx(tau)
    # A circle: (tau - 1)^2 / 50^2 + t^2 = 1.
    for t in np.linspace(0, 1, 21):
        assert ((clamp_px(ACE, t) - 1) / 50) ** 2 + t * t == pytest.approx(1.0)


def test_exponential_schedule_halves_in_equal_steps() -> None:
    options = LossOptions(schedule="exponential", clamp_start_px=64.0, clamp_end_px=1.0)
    steps = [clamp_px(options, k / 6) for k in range(7)]
    assert steps == pytest.approx([64.0, 32.0, 16.0, 8.0, 4.0, 2.0, 1.0])


def test_loss_of_valid_rows_in_closed_form() -> None:
    cx = CAMERA.cx
    cy = CAMERA.cy
    pixels = [[cx, cy], [cx + 3, cy], [cx - 3, cy + 4], [cx + 100, cy - 200]]
    points, where = straight([[0.0, 0.0, 2.0]] * 4, pixels)
    loss, error = reprojection_loss(points, where, TAU, OPTIONS)
    expected = [TAU * math.tanh(e / TAU) for e in (0, 3, 7, 300)]
    np.testing.assert_allclose(loss.numpy(), expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        error.numpy(), [0, 3, 5, math.hypot(100, 200)], rtol=1e-5
    )


def test_invalid_rows_are_attracted_to_the_proxy_depth() -> None:
    cx = CAMERA.cx
    cy = CAMERA.cy
    fx = CAMERA.fx
    fy = CAMERA.fy
    pixel = [cx + 0.1 * fx, cy - 0.2 * fy]  # the ray (0.1, -0.2, 1)
    in_camera = [
        [0.3, 0.0, -2.0],  # behind the camera
        [0.0, 0.0, 0.05],  # too near
        [100.0, -200.0, 1000.5],  # too far
        [8.0, 0.0, 1.0],  # error of 2000 px
    ]
    points, where = straight(in_camera, [pixel] * 4)
    loss, error = reprojection_loss(points, where, TAU, OPTIONS)
    proxy = np.array([1.0, -2.0, 10.0])
    expected = np.abs(np.array(in_camera) - proxy).sum(1)
    np.testing.assert_allclose(loss.numpy(), expected, rtol=1e-5)
    assert torch.isinf(error).all()
    at_proxy, there = straight([proxy.tolist()], [pixel])
    loss, error = reprojection_loss(
        at_proxy, there, TAU, replace(OPTIONS, proxy_depth_m=10.0)
    )
    assert float(loss) < 1e-3
    assert float(error) < 1e-3


@pytest.mark.parametrize("kind", ["valid", "behind", "far_off"])
def test_step_against_the_gradient_lowers_the_loss(kind: str) -> None:
    poses, in_camera, atlas = scattered(3)
    rng = np.random.default_rng(4)
    wrong = in_camera + rng.normal(0, 0.05, in_camera.shape) * in_camera[:, 2:]
    if kind == "behind":
        wrong[:, 2] *= -1
    elif kind == "far_off":
        wrong[:, 0] += 6 * in_camera[:, 2]
    points = torch.from_numpy(poses.apply(wrong)).float().requires_grad_()
    where = target(CAMERA.project(in_camera), poses)
    loss, error = reprojection_loss(points, where, 50.0, OPTIONS)
    assert torch.isfinite(error).all() == (kind == "valid")
    assert not error.requires_grad
    (gradient,) = torch.autograd.grad(loss.sum(), points)
    assert torch.isfinite(gradient).all()
    length = gradient.norm(dim=-1, keepdim=True)
    assert (length > 0).all()
    after, _ = reprojection_loss(
        points - 1e-3 * gradient / length, where, 50.0, OPTIONS
    )
    assert (
        after < loss
    ).float().mean() > 0.98  # a step can cross a kink of the L1 norm
    truth = torch.from_numpy(atlas).float()
    assert float(reprojection_loss(truth, where, 50.0, OPTIONS)[0].max()) < 0.05


def test_surface_loss_is_the_logarithm_of_the_distance_in_pixels() -> None:
    matrix = torch.eye(4)[:3].repeat(3, 1, 1)
    target = Target(
        torch.zeros(3, 2), torch.tensor([[200.0, 200.0, 0.0, 0.0]] * 3), matrix
    )
    known = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0], [torch.nan] * 3])
    points = known.nan_to_num() + torch.tensor(
        [[0.1, 0.0, 0.0], [0.1, 0.2, -0.3], [1.0] * 3]
    )
    points.requires_grad_()
    loss = surface_loss(points, known, target, 20.0)
    # 0.1 m at 2 m are 10 px, 0.6 m at 4 m are 30 px; a row without a known point has no loss.
    expected = 20 * torch.log1p(torch.tensor([10.0, 30.0, 0.0]) / 20)
    torch.testing.assert_close(loss, expected)
    (gradient,) = torch.autograd.grad(loss.sum(), points)
    assert bool(gradient.isfinite().all())
    assert float(gradient[2].abs().max()) == 0
    # The scale does not fall below that of swept depths.
    torch.testing.assert_close(
        surface_loss(points, known, target, 1.0)[0],
        5 * torch.log1p(torch.tensor(10.0) / 5),
    )
