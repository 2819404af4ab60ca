"""The frozen local encoder: one feature vector for every cell of 8x8 pixels.

The shipped weights are trained on procedural images alone (`python -m training`). Weight files in
ACE's published layout can be read, too, and any module with `stride` and `width` can be used.
"""

from copy import deepcopy
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

from evercal.errors import InputError
from evercal.features.device import device_of_network
from evercal.features.weights_file import load_strictly
from evercal.storage.tensors import load_tensors

WEIGHTS = Path(__file__).parent / "weights"
ENCODER_FILE = WEIGHTS / "encoder.safetensors"
_SETTINGS = ("stem", "inner", "blocks", "width")


@runtime_checkable
class Encoder(Protocol):
    """Interface of a local encoder."""

    stride: int
    """Pixels per cell. Cell (i, j) is centred on pixel (stride (j + 0.5) - 0.5, same for i)."""
    width: int
    """Channels of a feature vector."""

    def __call__(self, grey: Tensor) -> Tensor:
        """(b, 1, h, w) in [0, 1] -> (b, width, h // stride, w // stride)."""
        ...


class _ConvBlock(nn.Sequential):
    """Convolution and batch norm; `fused` holds the inference form with the norm folded in."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, fused: bool):
        padding = kernel // 2 if stride == 1 else 0
        conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=fused)
        super().__init__(conv) if fused else super().__init__(conv, nn.BatchNorm2d(outputs))


class _Residual(nn.Module):
    def __init__(self, width: int, fused: bool):
        super().__init__()
        self.layers = nn.ModuleList(_ConvBlock(width, width, k, 1, fused) for k in (3, 1, 3))

    def forward(self, x: Tensor) -> Tensor:
        y = x
        for i, layer in enumerate(self.layers):
            y = layer(y) if i == 2 else F.relu(layer(y), inplace=True)
        return F.relu(y + x, inplace=True)


class LocalEncoder(nn.Module):
    """Stride-8 convolutional encoder with receptive fields centred on the cells.

    Space-to-depth and 2x2 convolutions shrink the image, so cell (i, j) is centred on pixel
    (8 j + 3.5, 8 i + 3.5), where (0, 0) is the centre of the first pixel. Strided 3x3 convolutions
    would be centred on (8 j, 8 i), half a cell off.

    `stem` are the channels at 1/2 and 1/4 resolution; `inner` channels and `blocks` of 3x3, 1x1 and
    3x3 are at 1/8. Batch norm is folded into the convolutions, `fused`, except for training.
    """

    stride = 8

    def __init__(
        self,
        stem: tuple[int, int] = (32, 64),
        inner: int = 160,
        blocks: int = 3,
        width: int = 128,
        fused: bool = True,
    ):
        super().__init__()
        self.width = width
        values = (list(stem), inner, blocks, width)
        self.settings: dict[str, Any] = dict(zip(_SETTINGS, values, strict=True))
        half, quarter = stem
        layers = ((4, half, 3, 1), (half, half, 3, 1), (half, quarter, 2, 2))
        layers += ((quarter, quarter, 3, 1), (quarter, inner, 2, 2))
        self.stem = nn.ModuleList(_ConvBlock(*layer, fused) for layer in layers)
        self.blocks = nn.ModuleList(_Residual(inner, fused) for _ in range(blocks))
        self.project = nn.Conv2d(inner, width, 1)

    def forward(self, grey: Tensor) -> Tensor:
        """(b, 1, h, w) in [0, 1] -> (b, width, h // 8, w // 8) unit vectors."""
        height, width = (side // 8 * 8 for side in grey.shape[-2:])
        x = standardise(grey[..., :height, :width])
        x = F.pixel_unshuffle(x, 2).contiguous(memory_format=torch.channels_last)
        for layer in self.stem:
            x = F.relu(layer(x), inplace=True)
        for block in self.blocks:
            x = block(x)
        return F.normalize(self.project(x).float(), dim=1)

    def fuse(self) -> "LocalEncoder":
        """The same function with batch norm folded in, for inference."""
        trained, twin = deepcopy(self).eval(), LocalEncoder(**self.settings)
        source = [m for m in trained.modules() if isinstance(m, _ConvBlock)]
        target = [m for m in twin.modules() if isinstance(m, _ConvBlock)]
        for a, b in zip(source, target, strict=True):
            conv = fuse_conv_bn_eval(cast(nn.Conv2d, a[0]), cast(nn.BatchNorm2d, a[1]))
            b[0].load_state_dict(conv.state_dict())
        twin.project.load_state_dict(self.project.state_dict())
        return twin.eval()


def standardise(grey: Tensor) -> Tensor:
    """Scale each image to mean 0 and standard deviation 1, which removes exposure and contrast."""
    mean = grey.mean(dim=(-3, -2, -1), keepdim=True)
    deviation = grey.std(dim=(-3, -2, -1), keepdim=True)
    return (grey - mean) / (deviation + 1e-3)


class AceEncoder(nn.Module):
    """The layer layout of ACE's published encoder (Brachmann et al., CVPR 2023), without weights.

    Stride 8, grey input normalised as (x - 0.4) / 0.25, `width` output channels. The weight file
    has a non-commercial licence of its own and is not shipped.
    """

    stride = 8

    def __init__(self, width: int = 512):
        super().__init__()
        self.width = width
        self.settings = {"width": width}

        def conv(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Conv2d:
            return nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2)

        self.conv1 = conv(1, 32, 3)
        self.conv2 = conv(32, 64, 3, 2)
        self.conv3 = conv(64, 128, 3, 2)
        self.conv4 = conv(128, 256, 3, 2)
        self.res1_conv1, self.res1_conv2 = conv(256, 256, 3), conv(256, 256, 1)
        self.res1_conv3 = conv(256, 256, 3)
        self.res2_conv1, self.res2_conv2 = conv(256, 512, 3), conv(512, 512, 1)
        self.res2_conv3 = conv(512, width, 3)
        self.res2_skip = conv(256, width, 1)

    def forward(self, grey: Tensor) -> Tensor:
        """(b, 1, h, w) in [0, 1] -> (b, width, h // 8, w // 8)."""
        height, width = (side // 8 * 8 for side in grey.shape[-2:])
        x = (grey[..., :height, :width] - 0.4) / 0.25
        for layer in (self.conv1, self.conv2, self.conv3, self.conv4):
            x = F.relu(layer(x))
        y = x
        for layer in (self.res1_conv1, self.res1_conv2, self.res1_conv3):
            y = F.relu(layer(y))
        x = x + y
        y = F.relu(self.res2_conv2(F.relu(self.res2_conv1(x))))
        return (self.res2_skip(x) + F.relu(self.res2_conv3(y))).float()


def checked_encoder(module: nn.Module) -> Encoder:
    """Freeze a user's module as an encoder."""
    if not isinstance(module, Encoder):
        raise InputError(
            f"encoder {type(module).__name__}: needs integer attributes 'stride' and 'width'"
        )
    module.eval().requires_grad_(False)
    side = 8 * module.stride
    with torch.inference_mode():
        image = torch.zeros(1, 1, side, side, device=device_of_network(module))
        shape = tuple(module(image).shape)
    if shape != (1, module.width, 8, 8):
        raise InputError(
            f"encoder {type(module).__name__}: made {shape} from a (1, 1, {side}, {side}) image;"
            f" stride {module.stride} and width {module.width} require (1, {module.width}, 8, 8)"
        )
    return module


def own_encoder(module: nn.Module, path: Path) -> Encoder:
    """Load the weights of a file into a user's module."""
    state = {name: value.float() for name, value in load_tensors(path).items()}
    load_strictly(module, state, f"{path}: not the weights of the given encoder")
    return checked_encoder(module)


def load_encoder(path: Path | None = None) -> LocalEncoder | AceEncoder:
    """The shipped encoder, or that of a file of `training` or ACE's published weights."""
    path = ENCODER_FILE if path is None else path
    if not path.is_file():
        raise InputError(f"encoder {path}: no such file")
    if path.suffix == ".safetensors":
        return _load_own(path)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # torch's own messages have ten lines.
        reason = (str(error).splitlines() or [repr(error)])[0]
        raise InputError(f"encoder {path}: not a readable torch weight file ({reason})") from error
    return ace_encoder_from_state(state, str(path))


def ace_encoder_from_state(state: object, name: str) -> AceEncoder:
    """Build an `AceEncoder` from a state dict in ACE's layout."""
    if not isinstance(state, dict) or "res2_skip.weight" not in state:
        raise InputError(
            f"encoder {name}: not ACE's layout (no tensor 'res2_skip.weight'); "
            "use ACE's published encoder file or a file of 'python -m training'"
        )
    shape = getattr(state["res2_skip.weight"], "shape", ())
    encoder = AceEncoder(int(shape[0]) if len(shape) == 4 else 512)
    load_strictly(encoder, state, f"encoder {name}: does not match ACE's layout")
    return encoder.eval()


def _load_own(path: Path) -> LocalEncoder | AceEncoder:
    import json

    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            settings = json.loads((file.metadata() or {})["encoder"])
            state = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118
        if settings.get("layout") == AceEncoder.__name__:
            return ace_encoder_from_state(state, str(path))
        if settings.get("layout", LocalEncoder.__name__) != LocalEncoder.__name__:
            raise InputError(
                f"encoder {path}: weights of the module {settings['layout']!r}; pass that module as"
                " encoder"
            )
        encoder = LocalEncoder(**{name: settings[name] for name in _SETTINGS})
    except (SafetensorError, KeyError, ValueError) as error:
        raise InputError(f"encoder {path}: not an evercal encoder file ({error!r})") from error
    load_strictly(encoder, state, f"encoder {path}: not an evercal encoder file")
    return encoder.eval().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
