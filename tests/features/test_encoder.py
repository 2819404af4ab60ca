"""The local encoder: receptive fields, fused form, and weight files."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.errors import InputError
from evercal.features import encoder as module
from evercal.features.encoder import AceEncoder, Encoder, LocalEncoder, load_encoder
from evercal.features.weights_file import network_bytes

ACE_LAYERS = ("conv1", "conv2", "conv3", "conv4", "res1_conv1", "res1_conv2", "res1_conv3")
ACE_LAYERS += ("res2_conv1", "res2_conv2", "res2_conv3", "res2_skip")


def small(fused: bool, blocks: int = 2) -> LocalEncoder:
    return LocalEncoder((6, 8), 10, blocks, 12, fused=fused)


def trained() -> LocalEncoder:
    """An encoder whose batch norms are far from the identity, as after training."""
    torch.manual_seed(3)
    encoder = small(fused=False)
    for name, tensor in encoder.state_dict().items():
        kind = name.rpartition(".")[2]
        if kind == "running_mean":
            tensor.normal_(0.0, 0.3)
        elif kind == "running_var" or (kind == "weight" and tensor.ndim == 1):
            tensor.uniform_(0.3, 2.0)
    return encoder.eval()


def images(height: int, width: int, count: int = 2) -> Tensor:
    return torch.rand(count, 1, height, width, generator=torch.Generator().manual_seed(7))


def receptive_field(encoder: nn.Module, image: Tensor, row: int, column: int) -> np.ndarray:
    """(n, 2) pixels (u, v) that the output of one cell depends on."""
    image = image.clone().requires_grad_()
    weight = torch.rand(encoder(image).shape[1], generator=torch.Generator().manual_seed(1))
    (encoder(image)[0, :, row, column] @ weight).backward()
    assert image.grad is not None
    v, u = torch.nonzero(image.grad[0, 0], as_tuple=True)
    return torch.stack([u, v], -1).numpy()


@pytest.mark.parametrize(("row", "column"), [(8, 9), (9, 8), (10, 11)])
def test_receptive_fields_are_centred_on_the_cells(
    monkeypatch: pytest.MonkeyPatch, row: int, column: int
) -> None:
    """Without the global standardisation; positive weights leave every path open."""
    monkeypatch.setattr(module, "standardise", lambda grey: grey)
    torch.manual_seed(0)
    encoder = small(fused=True)
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
    assert (receptive_field(strided, images(160, 176, 1), row, column).mean(0) != centre).all()


def test_fused_equals_unfused() -> None:
    encoder = trained()
    image = images(48, 64)
    with torch.no_grad():
        twin = encoder.fuse()
        assert not any(isinstance(layer, nn.BatchNorm2d) for layer in twin.modules())
        torch.testing.assert_close(twin(image), encoder(image), atol=2e-5, rtol=0)


@pytest.mark.parametrize("size", [(48, 64), (55, 57), (8, 8), (15, 9)])
def test_pixels_beyond_whole_cells_are_cut_off(size: tuple[int, int]) -> None:
    height, width = size
    image = images(height, width)
    for encoder in (trained(), AceEncoder(16)):
        with torch.no_grad():
            features = encoder(image)
            cropped = encoder(image[..., : height // 8 * 8, : width // 8 * 8])
        assert features.shape == (2, encoder.width, height // 8, width // 8)
        torch.testing.assert_close(features, cropped, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("contrast", "brightness"), [(1.0, 0.3), (0.5, 0.0), (0.4, 0.5)])
def test_brightness_and_contrast_have_no_effect(contrast: float, brightness: float) -> None:
    encoder, image = trained(), images(48, 64)
    with torch.no_grad():
        before, after = encoder(image), encoder(contrast * image + brightness)
        assert torch.isfinite(encoder(torch.zeros(1, 1, 16, 16))).all()  # a black image
    torch.testing.assert_close(before.norm(dim=1), torch.ones_like(before[:, 0]))
    # Not exactly: 1e-3 is added to the contrast, for black images.
    assert float((before * after).sum(1).min()) > 0.9995


def test_images_of_a_batch_are_independent() -> None:
    encoder, image = trained(), images(48, 64, 3)
    with torch.no_grad():
        together = encoder(image * torch.tensor([1.0, 0.2, 0.7]).view(3, 1, 1, 1))
        alone = encoder(image[1:2] * 0.2)
    torch.testing.assert_close(together[1:2], alone, atol=1e-5, rtol=0)


def test_weight_file_has_half_precision(tmp_path: Path) -> None:
    encoder = trained().fuse()
    path = tmp_path / "encoder.safetensors"
    path.write_bytes(network_bytes(encoder, "encoder"))
    loaded = load_encoder(path)
    assert isinstance(loaded, LocalEncoder)
    assert isinstance(loaded, Encoder)
    assert (loaded.width, loaded.stride, loaded.settings) == (12, 8, encoder.settings)
    assert not any(layer.training for layer in loaded.modules())
    with torch.no_grad():
        expected = encoder.half().float()(images(48, 64))
        torch.testing.assert_close(loaded(images(48, 64)), expected, atol=1e-5, rtol=0)
    assert network_bytes(loaded, "encoder") == path.read_bytes()


def ace_state(width: int, seed: int = 0) -> dict[str, Tensor]:
    """Random weights under the names and shapes of ACE's published file."""
    channels = [(1, 32), (32, 64), (64, 128), (128, 256), *[(256, 256)] * 3]
    channels += [(256, 512), (512, 512), (512, width), (256, width)]
    kernels = [3, 3, 3, 3, 3, 1, 3, 3, 1, 3, 1]
    random = torch.Generator().manual_seed(seed)
    state = {}
    for name, (inputs, outputs), kernel in zip(ACE_LAYERS, channels, kernels, strict=True):
        scale = (inputs * kernel * kernel) ** -0.5
        weight = torch.randn(outputs, inputs, kernel, kernel, generator=random) * scale
        state[f"{name}.weight"] = weight
        state[f"{name}.bias"] = torch.randn(outputs, generator=random) * 0.1
    return state


def ace_by_hand(state: dict[str, Tensor], grey: Tensor) -> Tensor:
    """The published layer table, written out."""

    def conv(name: str, x: Tensor, stride: int = 1) -> Tensor:
        weight = state[f"{name}.weight"]
        padding = weight.shape[-1] // 2
        return F.conv2d(x, weight, state[f"{name}.bias"], stride, padding)

    x = conv("conv1", (grey - 0.4) / 0.25).relu()
    x = conv("conv2", x, 2).relu()
    x = conv("conv3", x, 2).relu()
    x = conv("conv4", x, 2).relu()
    y = conv("res1_conv3", conv("res1_conv2", conv("res1_conv1", x).relu()).relu()).relu()
    x = x + y
    y = conv("res2_conv3", conv("res2_conv2", conv("res2_conv1", x).relu()).relu()).relu()
    return conv("res2_skip", x) + y


@pytest.mark.parametrize("width", [512, 64])
def test_ace_file_computes_the_published_function(tmp_path: Path, width: int) -> None:
    state = ace_state(width)
    torch.save(state, tmp_path / "ace.pt")
    encoder = load_encoder(tmp_path / "ace.pt")
    assert isinstance(encoder, AceEncoder)
    assert isinstance(encoder, Encoder)
    assert encoder.width == width
    assert sum(parameter.numel() for parameter in AceEncoder(512).parameters()) == 5_568_000
    image = images(40, 48)
    with torch.no_grad():
        torch.testing.assert_close(encoder(image), ace_by_hand(state, image), atol=1e-5, rtol=1e-5)
    (tmp_path / "own.safetensors").write_bytes(network_bytes(encoder, "encoder"))
    again = load_encoder(tmp_path / "own.safetensors")
    assert isinstance(again, AceEncoder)
    with torch.no_grad():
        expected = ace_by_hand({k: v.half().float() for k, v in state.items()}, image)
        torch.testing.assert_close(again(image), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"conv3.bias": None}, "conv3.bias"),
        ({"res2_skip.weight": None}, "res2_skip.weight"),
        ({"conv1.weight": torch.zeros(32, 3, 3, 3)}, "conv1.weight"),
        ({"res2_skip.weight": torch.zeros(64)}, "ACE's layout"),
        ({"conv2.bias": "text"}, "conv2.bias"),
    ],
)
def test_wrong_tensors_of_an_ace_file_are_refused_by_name(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    state = {k: v for k, v in {**ace_state(64), **change}.items() if v is not None}
    torch.save(state, tmp_path / "ace.pt")
    refused(tmp_path / "ace.pt", message)


def test_other_files_are_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none.pt", "no such file")
    refused(tmp_path, "no such file")
    torch.save([1, 2], tmp_path / "list.pt")
    refused(tmp_path / "list.pt", "ACE's layout")
    torch.save(nn.Linear(2, 2), tmp_path / "pickle.pt")  # runs code when unpickled
    refused(tmp_path / "pickle.pt", "not a readable torch weight file")
    (tmp_path / "text.pt").write_text("hello")
    refused(tmp_path / "text.pt", "not a readable torch weight file")


def test_broken_encoder_files_are_refused(tmp_path: Path) -> None:
    from safetensors.torch import save

    good = network_bytes(trained().fuse(), "encoder")
    broken = {
        "cut": good[: len(good) // 2],
        "empty": b"",
        "other_kind": network_bytes(trained().fuse(), "descriptor"),
        "no_settings": save({"a": torch.zeros(1)}),
        "bad_settings": save({"a": torch.zeros(1)}, {"encoder": "{"}),
        "unfused": network_bytes(trained(), "encoder"),
    }
    for name, data in broken.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(data)
        refused(path, "not an evercal encoder")


def refused(path: Path, message: str) -> None:
    with pytest.raises(InputError, match="encoder") as caught:
        load_encoder(path)
    text = str(caught.value)
    assert str(path) in text
    assert message in text
    assert len(text.splitlines()) == 1
