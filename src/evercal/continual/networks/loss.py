"""The reprojection loss of ACE and GLACE and the schedule of its clamp."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from evercal.classes import frozen
from evercal.errors import require_numbers

MIN_DEPTH_M = 0.1
"""Minimum depth of a valid point, metres."""
MAX_DEPTH_M = 1000.0
"""Maximum depth of a valid point, metres."""
MAX_ERROR_PX = 1000.0
"""Maximum L1 reprojection error of a valid point, pixels."""
FIXED_CLAMP_PX = 5.0
"""Soft clamp of losses that are compared between steps, pixels."""
SURFACE_PX = 5.0
"""Minimum scale of the loss on known points, pixels: about the error of swept depths."""


@frozen
class LossOptions:
    """Robust reprojection loss."""

    schedule: Literal["circle", "exponential"] = "exponential"
    """Schedule of the soft clamp. ACE's circle stays wide until late; the exponential halves in
    equal steps and recovers better from a bad start."""
    clamp_start_px: float = 100.0
    """Soft clamp at the first step. With `circle`, its excess over `clamp_end_px`."""
    clamp_end_px: float = 1.0
    """Soft clamp at the last step, pixels."""
    proxy_depth_m: float = 10.0
    """Invalid points are attracted to the point at this depth on their ray."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, vars(self).keys() - {"schedule"}, 1e-9)


@dataclass
class Target:
    """Observed pixels, cameras and poses of n rows."""

    pixels: Tensor
    """(n, 2) ideal-pinhole pixels."""
    intrinsics: Tensor
    """(n, 4) fx, fy, cx, cy."""
    camera_from_atlas: Tensor
    """(n, 3, 4)."""

    @property
    def focals(self) -> Tensor:
        """(n, 2) fx, fy."""
        return self.intrinsics[:, :2]

    @property
    def centres(self) -> Tensor:
        """(n, 2) cx, cy."""
        return self.intrinsics[:, 2:]


def clamp_px(options: LossOptions, progress: float) -> float:
    """Return the soft clamp tau at `progress` in [0, 1]."""
    start = options.clamp_start_px
    end = options.clamp_end_px
    if options.schedule == "exponential":
        return start * (end / start) ** progress
    q = 1.0 - math.sqrt(max(0.0, 1.0 - progress * progress))
    return start * (1.0 - q) + end


def reprojection_error(points: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Project points (n, 3) of the atlas: residuals (n, 2), pixels, and camera coordinates."""
    in_camera = _in_camera(points, target)
    depth = in_camera[:, 2:].clamp(min=MIN_DEPTH_M)
    plane = in_camera[:, :2] / depth
    projected = plane * target.focals + target.centres
    return projected - target.pixels, in_camera


def _in_camera(points: Tensor, target: Target) -> Tensor:
    """Camera coordinates (n, 3) of points (n, 3) of the atlas."""
    return _rotated(points, target) + target.camera_from_atlas[:, :, 3]


def _rotated(vectors: Tensor, target: Target) -> Tensor:
    matrices = target.camera_from_atlas[:, :, :3]
    if vectors.device.type == "cpu":
        return torch.einsum("nij,nj->ni", matrices, vectors)
    # A matrix product may round to TF32, an error of millimetres in a room; a sum does not.
    return (matrices * vectors[:, None]).sum(-1)


def reprojection_loss(
    points: Tensor,
    target: Target,
    tau: float,
    options: LossOptions,
) -> tuple[Tensor, Tensor]:
    """Compute the loss (n,) of every row, and its L2 error in pixels; infinite for invalid rows.

    A valid row has a depth in [0.1, 1000] m and an L1 error e below 1000 px; its loss is
    tau tanh(e / tau). The loss of an invalid row is the L1 distance in metres to the point at the
    proxy depth on its ray. Errors have no gradient.
    """
    residual, in_camera = reprojection_error(points, target)
    error = residual.abs().sum(-1)
    depth = in_camera[:, 2]
    valid = (depth > MIN_DEPTH_M) & (depth < MAX_DEPTH_M) & (error < MAX_ERROR_PX)
    robust = tau * torch.tanh(error / tau)
    plane = (target.pixels - target.centres) / target.focals
    ray = torch.cat([plane, torch.ones_like(plane[:, :1])], -1)
    proxy = ray * options.proxy_depth_m
    to_proxy = (proxy - in_camera).abs().sum(-1)
    loss = torch.where(valid, robust, to_proxy)
    pixels = residual.detach().norm(dim=-1)
    return loss, torch.where(valid, pixels, torch.inf)


def surface_loss(
    points: Tensor, known: Tensor, target: Target, tau_px: float
) -> Tensor:
    """Compute the robust distance (n,) of points from known ones, in pixels at their depth.

    With e the L1 distance along the axes of the camera, times the focal length over the known
    depth, the loss is t ln(1 + e / t), t = max(tau, 5 px). To first order, the part of e across
    the ray is the reprojection error. Unlike that of a clamp, the gradient of a far point does not
    vanish, so every row is attracted from the first step. Where the known point is NaN, the loss is
    0. tau is the soft clamp of the reprojection loss in this step.
    """
    has_point = ~known[:, 0].isnan()
    known = torch.where(has_point[:, None], known, points.detach())
    gap = _rotated(points - known, target).abs().sum(-1)
    depth = _in_camera(known, target)[:, 2].clamp(min=MIN_DEPTH_M)
    error = gap * target.intrinsics[:, 0] / depth
    scale = max(tau_px, SURFACE_PX)
    robust = scale * torch.log1p(error / scale)
    return torch.where(has_point, robust, 0.0)


def fixed_clamp_loss(
    points: Tensor, target: Target, tau: float = FIXED_CLAMP_PX
) -> tuple[Tensor, Tensor]:
    """Compute `reprojection_loss` with a fixed clamp, which makes different steps comparable."""
    return reprojection_loss(points, target, tau, LossOptions())
