"""Head, buffer and loss on a GPU: the results of the CPU."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from evercal.continual.networks.buffer import FeatureBuffer, Rows, join
from evercal.continual.networks.head import Head, HeadOptions, fresh_head
from evercal.continual.networks.loss import LossOptions, reprojection_loss
from evercal.geometry import SE3

from ..draws import normal, seeded

SHAPES = [
    HeadOptions(width=12, condition="code", offsets="per_centre"),
    HeadOptions(width=12, condition="code", offsets="shared"),
    HeadOptions(
        width=12, condition="descriptor", offsets="per_centre", centres="fixed"
    ),
]
CPU = torch.device("cpu")


def head_of(options: HeadOptions, device: torch.device) -> Head:
    """Create a head for three scenes that was moved before growth and whitening."""
    head = fresh_head(7, 4, options, seed=5).to(device)
    for scene in range(3):
        head.grow(3 * normal(2, 3, seed=scene), seed=scene)
    head.whiten((normal(60, 7, seed=9) + 1).to(device))
    return head


def buffer_of(device: torch.device, scene: int = 1) -> FeatureBuffer:
    """Create forty rows of two views with known points."""
    buffer = FeatureBuffer(scene, SE3.identity(), device=device)
    matrix = torch.eye(4, device="cpu")[None, :3] + 0.1 * normal(2, 3, 4, seed=2)
    matrix[:, 2, 3] += 8  # most points are in front of the camera
    buffer.extend(
        {
            "features": normal(40, 7).half(),
            "pixels": 20 * normal(40, 2, seed=1) + 50,
            "view": torch.arange(2, dtype=torch.int32, device="cpu").repeat_interleave(
                20
            ),
            "intrinsics": torch.tensor([[100.0, 100, 50, 50]] * 2, device="cpu"),
            "camera_from_atlas": matrix,
            "descriptors": torch.nn.functional.normalize(normal(2, 4, seed=3)),
        }
    )
    buffer.known = normal(40, 3, seed=4).to(device)
    return buffer


def drawn(buffers: list[FeatureBuffer]) -> Rows:
    generator = seeded(1)
    plain = buffer_of(buffers[0].device)
    plain.known = FeatureBuffer(0, SE3.identity(), buffers[0].device).known
    return join(
        [*(buffer.draw(16, generator) for buffer in buffers), plain.draw(8, generator)]
    )


def everything(rows: Rows) -> dict[str, Tensor]:
    fields = (rows.features, rows.scene, rows.descriptor, rows.known)
    names = ("features", "scene", "descriptor", "stored")
    target = rows.target
    return dict(zip(names, fields, strict=True)) | {
        "pixels": target.pixels,
        "intrinsics": target.intrinsics,
        "camera_from_atlas": target.camera_from_atlas,
    }


def step(head: Head, rows: Rows, scene: Tensor | int) -> dict[str, Tensor]:
    """Compute loss and error of rows, and the gradient of every parameter, in fp32."""
    output = head(rows.features.float(), scene, rows.descriptor)
    loss, error = reprojection_loss(output.points, rows.target, 7.0, LossOptions())
    loss.mean().backward()
    gradients = {
        name: p.grad for name, p in head.named_parameters() if p.grad is not None
    }
    assert {"logit", "offset", "first.0.weight"} <= gradients.keys()
    assert error.isfinite().float().mean() > 0.5
    return gradients | {
        "loss": loss.detach(),
        "error": error,
        "points": output.points.detach(),
    }


@pytest.mark.gpu
def test_rows_are_equal_on_every_device(cuda: torch.device) -> None:
    expected = everything(drawn([buffer_of(CPU), buffer_of(CPU, 2)]))
    for name, value in everything(drawn([buffer_of(cuda), buffer_of(cuda, 2)])).items():
        assert value.device == cuda, name
        assert torch.equal(value.cpu().nan_to_num(-7), expected[name].nan_to_num(-7)), (
            name
        )
    assert torch.isnan(expected["stored"]).any()


@pytest.mark.gpu
@pytest.mark.parametrize("options", SHAPES)
def test_step_is_equal_on_every_device(
    options: HeadOptions, cuda: torch.device
) -> None:
    for scene in (None, 1):
        actual = []
        for where in (CPU, cuda):
            rows = drawn([buffer_of(where), buffer_of(where, 2)])
            actual.append(
                step(head_of(options, where), rows, rows.scene if scene is None else 1)
            )
        for name, expected in actual[0].items():
            value = actual[1][name]
            assert value.device == cuda, name
            size = float(expected[expected.isfinite()].abs().max()) + 1e-6
            torch.testing.assert_close(
                value.cpu(), expected, atol=1e-3 * size, rtol=1e-3
            )
