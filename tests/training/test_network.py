"""The encoder as a module and as an ONNX file: receptive fields, batch norm, sizes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from evercal.features.encoder import load_encoder
from training import network as module
from training.network import Layout, LocalEncoder, from_onnx, onnx_bytes

pytestmark = pytest.mark.slow("training", "src/evercal/features")

LAYOUTS = {
    "fold 2": Layout(2, ((6, 3, 1), (8, 2, 2), (10, 2, 2)), (3, 1, 3), 2, 12),
    "fold 4": Layout(4, ((6, 3, 1), (10, 2, 2)), (3, 3), 2, 12),
}


@pytest.fixture(params=LAYOUTS)
def trained(request: pytest.FixtureRequest) -> LocalEncoder:
    """An encoder whose batch norms are far from the identity, as after training."""
    torch.manual_seed(3)
    encoder = LocalEncoder(LAYOUTS[request.param], fused=False)
    for name, tensor in encoder.state_dict().items():
        kind = name.rpartition(".")[2]
        if kind == "running_mean":
            tensor.normal_(0.0, 0.3)
        elif kind == "running_var" or (kind == "weight" and tensor.ndim == 1):
            tensor.uniform_(0.3, 2.0)
    return encoder.eval()


def images(height: int, width: int, count: int = 2) -> Tensor:
    return torch.rand(
        count, 1, height, width, generator=torch.Generator().manual_seed(7)
    )


def receptive_field(
    encoder: nn.Module, image: Tensor, row: int, column: int
) -> np.ndarray:
    """(n, 2) pixels (u, v) that the output of one cell depends on."""
    image = image.clone().requires_grad_()
    weight = torch.rand(
        encoder(image).shape[1], generator=torch.Generator().manual_seed(1)
    )
    (encoder(image)[0, :, row, column] @ weight).backward()
    assert image.grad is not None
    v, u = torch.nonzero(image.grad[0, 0], as_tuple=True)
    return torch.stack([u, v], -1).numpy()


@pytest.mark.parametrize(("row", "column"), [(8, 9), (9, 8), (10, 11)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_receptive_fields_are_centred_on_the_cells(
    monkeypatch: pytest.MonkeyPatch, layout: str, row: int, column: int
) -> None:
    """Without the global standardisation; positive weights leave every path open."""
    monkeypatch.setattr(module, "standardise", lambda grey: grey)
    torch.manual_seed(0)
    encoder = LocalEncoder(LAYOUTS[layout])
    for name, parameter in encoder.named_parameters():
        if not name.startswith("project"):
            fan_in = parameter[0].numel()
            nn.init.uniform_(parameter, 0.5 / fan_in, 1.5 / fan_in)
    pixels = receptive_field(encoder, images(160, 176, 1), row, column)
    centre = np.array([8 * column + 3.5, 8 * row + 3.5])
    assert pixels.min() > 0  # not cut off by the border
    assert (pixels.max(0) < [175, 159]).all()
    np.testing.assert_array_equal((pixels.min(0) + pixels.max(0)) / 2, centre)
    np.testing.assert_array_equal(pixels.mean(0), centre)
    # Strided 3x3 convolutions are half a cell off.
    strided = nn.Sequential(*(nn.Conv2d(1, 1, 3, 2, 1, bias=False) for _ in range(3)))
    assert (
        receptive_field(strided, images(160, 176, 1), row, column).mean(0) != centre
    ).all()


@torch.no_grad()
def test_fused_equals_unfused(trained: LocalEncoder) -> None:
    twin = trained.fuse()
    assert not any(isinstance(layer, nn.BatchNorm2d) for layer in twin.modules())
    torch.testing.assert_close(
        twin(images(48, 64)), trained(images(48, 64)), atol=2e-5, rtol=0
    )


@torch.no_grad()
def test_images_of_a_batch_are_independent(trained: LocalEncoder) -> None:
    image = images(48, 64, 3)
    together = trained(image * torch.tensor([1.0, 0.2, 0.7]).view(3, 1, 1, 1))
    torch.testing.assert_close(
        together[1:2], trained(image[1:2] * 0.2), atol=1e-5, rtol=0
    )


@torch.no_grad()
@pytest.mark.parametrize("size", [(48, 64), (55, 57), (8, 8), (15, 9)])
def test_onnx_file_is_the_module_in_half_precision(
    trained: LocalEncoder, size: tuple[int, int], tmp_path: Path
) -> None:
    path = tmp_path / "encoder.onnx"
    path.write_bytes(onnx_bytes(trained.fuse()))
    encoder = load_encoder(path)
    again = from_onnx(path, trained.layout)
    grey = np.random.default_rng(0).integers(0, 256, size).astype(np.uint8)
    actual = encoder(grey)
    assert actual.shape == (size[0] // 8, size[1] // 8, trained.width)
    image = torch.from_numpy(grey[None, None]) / 255
    np.testing.assert_allclose(actual, again(image)[0].permute(1, 2, 0), atol=1e-5)
    np.testing.assert_allclose(actual, trained(image)[0].permute(1, 2, 0), atol=5e-3)
    assert onnx_bytes(again) == path.read_bytes()
