"""The local encoder: where its cells look, its inference form, and the files it is read from."""

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


def pictures(height: int, width: int, count: int = 2) -> Tensor:
    return torch.rand(count, 1, height, width, generator=torch.Generator().manual_seed(7))


def seen_by(encoder: nn.Module, image: Tensor, row: int, column: int) -> np.ndarray:
    """(n, 2) pixels (u, v) that the output of one cell depends on."""
    image = image.clone().requires_grad_()
    weight = torch.rand(encoder(image).shape[1], generator=torch.Generator().manual_seed(1))
    (encoder(image)[0, :, row, column] @ weight).backward()
    assert image.grad is not None
    v, u = torch.nonzero(image.grad[0, 0], as_tuple=True)
    return torch.stack([u, v], -1).numpy()


@pytest.mark.parametrize(("row", "column"), [(8, 9), (9, 8), (10, 11)])
def test_a_cell_looks_at_pixels_symmetric_around_its_centre(
    monkeypatch: pytest.MonkeyPatch, row: int, column: int
) -> None:
    """The standardisation is global and therefore left out; weights > 0 keep every path open."""
    monkeypatch.setattr(module, "standardise", lambda grey: grey)
    torch.manual_seed(0)
    encoder = small(fused=True)
    for name, parameter in encoder.named_parameters():
        if not name.startswith("project"):
            fan_in = parameter[0].numel()
            nn.init.uniform_(parameter, 0.5 / fan_in, 1.5 / fan_in)
    seen = seen_by(encoder, pictures(160, 176, 1), row, column)
    centre = np.array([8 * column + 3.5, 8 * row + 3.5])
    assert seen.min() > 0  # not cut off by the border, or the middle would prove nothing
    assert (seen.max(0) < [175, 159]).all()
    np.testing.assert_array_equal((seen.min(0) + seen.max(0)) / 2, centre)
    np.testing.assert_array_equal(seen.mean(0), centre)
    # Half a cell off, as with strided 3x3 convolutions, would be caught.
    strided = nn.Sequential(*(nn.Conv2d(1, 1, 3, 2, 1, bias=False) for _ in range(3)))
    assert (seen_by(strided, pictures(160, 176, 1), row, column).mean(0) != centre).all()


def test_fused_equals_unfused() -> None:
    encoder = trained()
    image = pictures(48, 64)
    with torch.no_grad():
        twin = encoder.fuse()
        assert not any(isinstance(layer, nn.BatchNorm2d) for layer in twin.modules())
        torch.testing.assert_close(twin(image), encoder(image), atol=2e-5, rtol=0)


def test_fusing_leaves_an_encoder_in_training_in_training() -> None:
    encoder = trained().train()
    encoder.fuse()
    assert all(layer.training for layer in encoder.modules())


@pytest.mark.parametrize("size", [(48, 64), (241, 323), (55, 57), (8, 8), (15, 9)])
def test_output_size_and_the_cut_off_rest(size: tuple[int, int]) -> None:
    height, width = size
    image = pictures(height, width)
    for encoder in (trained(), AceEncoder(16)):
        with torch.no_grad():
            features = encoder(image)
            cropped = encoder(image[..., : height // 8 * 8, : width // 8 * 8])
        assert features.shape == (2, encoder.width, height // 8, width // 8)
        torch.testing.assert_close(features, cropped, atol=1e-6, rtol=0)


def test_vectors_have_unit_length() -> None:
    with torch.no_grad():
        length = trained()(pictures(48, 64)).norm(dim=1)
    torch.testing.assert_close(length, torch.ones_like(length))


@pytest.mark.parametrize(("contrast", "brightness"), [(1.0, 0.3), (0.5, 0.0), (0.4, 0.5)])
def test_brightness_and_contrast_drop_out(contrast: float, brightness: float) -> None:
    encoder, image = trained(), pictures(48, 64)
    with torch.no_grad():
        before, after = encoder(image), encoder(contrast * image + brightness)
    # Not exactly: the 1e-3 that keeps a black image finite counts a little against contrast.
    assert float((before * after).sum(1).min()) > 0.9995


def test_each_image_of_a_batch_stands_for_itself() -> None:
    encoder, image = trained(), pictures(48, 64, 3)
    with torch.no_grad():
        together = encoder(image * torch.tensor([1.0, 0.2, 0.7]).view(3, 1, 1, 1))
        alone = encoder(image[1:2] * 0.2)
    torch.testing.assert_close(together[1:2], alone, atol=1e-5, rtol=0)


def test_a_black_image_gives_numbers() -> None:
    with torch.no_grad():
        assert torch.isfinite(trained()(torch.zeros(1, 1, 16, 16))).all()


def test_round_trip_through_a_file_rounds_to_half_and_no_more(tmp_path: Path) -> None:
    encoder = trained().fuse()
    path = tmp_path / "encoder.safetensors"
    path.write_bytes(network_bytes(encoder, "encoder"))
    found = load_encoder(path)
    assert isinstance(found, LocalEncoder)
    assert isinstance(found, Encoder)
    assert (found.width, found.stride, found.settings) == (12, 8, encoder.settings)
    assert not any(layer.training for layer in found.modules())
    with torch.no_grad():
        expected = encoder.half().float()(pictures(48, 64))
        torch.testing.assert_close(found(pictures(48, 64)), expected, atol=1e-5, rtol=0)
    assert network_bytes(found, "encoder") == path.read_bytes()


def test_the_shipped_encoder_loads() -> None:
    encoder = load_encoder()
    with torch.no_grad():
        features = encoder(pictures(240, 320, 1))
    assert features.shape == (1, encoder.width, 30, 40)
    assert torch.isfinite(features).all()


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
def test_aces_file_loads_and_computes_aces_function(tmp_path: Path, width: int) -> None:
    state = ace_state(width)
    torch.save(state, tmp_path / "ace.pt")
    encoder = load_encoder(tmp_path / "ace.pt")
    assert isinstance(encoder, AceEncoder)
    assert isinstance(encoder, Encoder)
    assert encoder.width == width
    image = pictures(40, 48)
    with torch.no_grad():
        torch.testing.assert_close(encoder(image), ace_by_hand(state, image), atol=1e-5, rtol=1e-5)
    (tmp_path / "own.safetensors").write_bytes(network_bytes(encoder, "encoder"))
    again = load_encoder(tmp_path / "own.safetensors")
    assert isinstance(again, AceEncoder)
    with torch.no_grad():
        expected = ace_by_hand({k: v.half().float() for k, v in state.items()}, image)
        torch.testing.assert_close(again(image), expected, atol=1e-5, rtol=1e-5)


def test_ace_layout_has_the_published_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in AceEncoder(512).parameters()) == 5_568_000
    assert set(AceEncoder(512).state_dict()) == set(ace_state(8))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"conv3.bias": None}, "conv3.bias"),
        ({"res2_skip.weight": None}, "res2_skip.weight"),
        ({"res3_conv1.weight": torch.zeros(1)}, "res3_conv1.weight"),
        ({"conv1.weight": torch.zeros(32, 3, 3, 3)}, "conv1.weight"),
        ({"res2_skip.weight": torch.zeros(64, 128, 1, 1)}, "res2_skip.weight"),
        ({"res2_skip.weight": torch.zeros(64)}, "ACE's layout"),
        ({"conv2.bias": "text"}, "conv2.bias"),
    ],
)
def test_a_file_that_is_nearly_aces_is_refused_by_name(
    tmp_path: Path, change: dict[str, object], named: str
) -> None:
    state = {k: v for k, v in {**ace_state(64), **change}.items() if v is not None}
    torch.save(state, tmp_path / "ace.pt")
    refused(tmp_path / "ace.pt", named)


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    refused(tmp_path / "none.pt", "no such file")
    refused(tmp_path, "no such file")
    torch.save([1, 2], tmp_path / "list.pt")
    refused(tmp_path / "list.pt", "ACE's layout")
    torch.save(nn.Linear(2, 2), tmp_path / "pickle.pt")  # runs code when unpickled
    refused(tmp_path / "pickle.pt", "not a readable torch weight file")
    (tmp_path / "text.pt").write_text("hello")
    refused(tmp_path / "text.pt", "not a readable torch weight file")


def test_broken_files_of_ours_are_refused_by_name(tmp_path: Path) -> None:
    from safetensors.torch import save

    good = network_bytes(trained().fuse(), "encoder")
    broken = {
        "cut": good[: len(good) // 2],
        "text": b"hello",
        "empty": b"",
        "other_kind": network_bytes(trained().fuse(), "descriptor"),
        "no_settings": save({"a": torch.zeros(1)}),
        "bad_settings": save({"a": torch.zeros(1)}, {"encoder": "{"}),
        "other_settings": save({"a": torch.zeros(1)}, {"encoder": "{}"}),
        "unfused": network_bytes(trained(), "encoder"),
    }
    for name, data in broken.items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(data)
        refused(path, "not an evercal encoder")


def refused(path: Path, named: str) -> None:
    with pytest.raises(InputError, match="encoder") as caught:
        load_encoder(path)
    message = str(caught.value)
    assert str(path) in message
    assert named in message
    assert len(message.splitlines()) == 1
