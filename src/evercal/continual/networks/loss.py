"""The reprojection loss of ACE and GLACE and its schedule."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

MIN_DEPTH_M = 0.1
MAX_DEPTH_M = 1000.0
MAX_ERROR_PX = 1000.0
FIXED_CLAMP_PX = 5.0
# A wide lens' corner: beyond it a polynomial in the radius means nothing.
MAX_RADIUS2 = 1.0


@dataclass(frozen=True)
class LossOptions:
    """Robust reprojection loss."""

    schedule: Literal["circle", "exponential"] = "exponential"
    """How the soft clamp narrows: ACE's circle stays wide until late, the exponential halves in
    equal steps and forgives a bad start."""
    clamp_start_px: float = 100.0
    """Soft clamp at the first step (circle: above `clamp_end_px`)."""
    clamp_end_px: float = 1.0
    """Soft clamp at the last step."""
    proxy_depth_m: float = 10.0
    """Points behind the camera or far off are pulled to this depth on their ray."""


@dataclass
class Target:
    """Where rows must project to."""

    pixels: Tensor
    """(n, 2) ideal-pinhole pixels."""
    intrinsics: Tensor
    """(n, 4) fx, fy, cx, cy."""
    camera_from_atlas: Tensor
    """(n, 3, 4)."""

    def to(self, device: torch.device, non_blocking: bool = False) -> "Target":
        """The same on a device."""
        parts = (self.pixels, self.intrinsics, self.camera_from_atlas)
        return Target(*(part.to(device, non_blocking=non_blocking) for part in parts))


def clamp_px(options: LossOptions, progress: float) -> float:
    """Soft clamp tau at `progress` in [0, 1]: wide first, tight last."""
    if options.schedule == "exponential":
        return options.clamp_start_px * (options.clamp_end_px / options.clamp_start_px) ** progress
    q = 1.0 - math.sqrt(max(0.0, 1.0 - progress * progress))
    return options.clamp_start_px * (1.0 - q) + options.clamp_end_px


def reprojection_error(
    points: Tensor, target: Target, correction: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Signed pixel residuals (n, 2) and camera coordinates (n, 3), all in fp32.

    Args:
        points: (n, 3) in the atlas.
        target: where they must project to.
        correction: (n, 5) correction of the nominal pinhole: relative focal length, shift of the
            principal point in units of the focal length (x, y), OpenCV's k1 and k2.
    """
    matrix = target.camera_from_atlas
    in_camera = _turned(matrix[:, :, :3], points) + matrix[:, :, 3]
    depth = in_camera[:, 2:].clamp(min=MIN_DEPTH_M)
    plane = in_camera[:, :2] / depth
    if correction is not None:
        radius2 = (plane * plane).sum(-1, keepdim=True).clamp(max=MAX_RADIUS2)
        bend = 1.0 + correction[:, 3:4] * radius2 + correction[:, 4:5] * radius2 * radius2
        plane = plane * bend * (1.0 + correction[:, :1]) + correction[:, 1:3]
    projected = plane * target.intrinsics[:, :2] + target.intrinsics[:, 2:]
    return projected - target.pixels, in_camera


def _turned(matrices: Tensor, points: Tensor) -> Tensor:
    """(n, 3) products of (n, 3, 3) and (n, 3) in full fp32."""
    if points.device.type == "cpu":
        return torch.einsum("nij,nj->ni", matrices, points)
    # A matrix product might round to TF32, which is millimetres in a room; sums never do.
    return (matrices * points[:, None]).sum(-1)


def reprojection_loss(
    points: Tensor,
    target: Target,
    tau: float,
    options: LossOptions,
    correction: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Loss of every row.

    Valid rows (depth in [0.1, 1000] m, L1 error at most 1000 px) cost tau tanh(e / tau); the others
    the L1 distance in metres to the point at the proxy depth on their ray.

    Returns:
        loss (n,) and the L2 error in pixels (n,), infinite for invalid rows and without gradient.
    """
    residual, in_camera = reprojection_error(points, target, correction)
    error = residual.abs().sum(-1)
    depth = in_camera[:, 2]
    valid = (depth > MIN_DEPTH_M) & (depth < MAX_DEPTH_M) & (error < MAX_ERROR_PX)
    robust = tau * torch.tanh(error / tau)
    focal, centre = target.intrinsics[:, :2], target.intrinsics[:, 2:]
    ray = torch.cat([(target.pixels - centre) / focal, torch.ones_like(error)[:, None]], -1)
    proxy = (ray * options.proxy_depth_m - in_camera).abs().sum(-1)
    loss = torch.where(valid, robust, proxy)
    pixels = torch.where(valid, residual.detach().norm(dim=-1), torch.inf)
    return loss, pixels


def fixed_clamp_loss(
    points: Tensor, target: Target, tau: float = FIXED_CLAMP_PX
) -> tuple[Tensor, Tensor]:
    """`reprojection_loss` with a fixed clamp, so that losses of different times can be compared.

    With the schedule of the training, the clamp would decide and not the points.
    """
    return reprojection_loss(points, target, tau, LossOptions())
