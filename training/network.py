"""Local encoders as PyTorch modules, and their export to the ONNX files that the package runs."""

from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval


class Layout(NamedTuple):
    """Layers of an encoder."""

    fold: int
    """Pixels per side that space-to-depth makes channels."""
    stem: tuple[tuple[int, int, int], ...]
    """Channels, kernel and stride of the convolutions down to 1/8 of the image."""
    kernels: tuple[int, ...]
    """Kernels of a residual block at 1/8."""
    blocks: int
    """Residual blocks."""
    width: int
    """Channels of the features."""


_STEM = (32, 3, 1), (32, 3, 1), (64, 2, 2), (64, 3, 1), (160, 2, 2)
TEACHER = Layout(2, _STEM, (3, 1, 3), 3, 128)
"""Trained by contrast; maps of version 0.2 and before use it."""
SHIPPED = Layout(4, ((32, 3, 1), (48, 3, 1), (112, 2, 2)), (3, 3), 3, 64)
"""Distilled from the teacher."""


class _ConvBlock(nn.Sequential):
    """Convolution and batch norm; `fused` holds the inference form with the norm folded in."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, fused: bool
    ):
        padding = kernel // 2 if stride == 1 else 0
        conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=fused)
        super().__init__(conv) if fused else super().__init__(
            conv, nn.BatchNorm2d(outputs)
        )


class _Residual(nn.Module):
    def __init__(self, width: int, kernels: tuple[int, ...], fused: bool):
        super().__init__()
        self.layers = nn.ModuleList(
            _ConvBlock(width, width, k, 1, fused) for k in kernels
        )

    def forward(self, x: Tensor) -> Tensor:
        y = x
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            y = layer(y) if i == last else F.relu(layer(y), inplace=True)
        return F.relu(y + x, inplace=True)


class LocalEncoder(nn.Module):
    """Stride-8 convolutional encoder with receptive fields centred on the cells.

    Space-to-depth and 2x2 convolutions shrink the image, so cell (i, j) is centred on pixel
    (8 j + 3.5, 8 i + 3.5), where (0, 0) is the centre of the first pixel. Strided 3x3 convolutions
    would be centred on (8 j, 8 i), half a cell off.

    Batch norm is folded into the convolutions, `fused`, except for training.
    """

    stride = 8

    def __init__(self, layout: Layout, fused: bool = True):
        super().__init__()
        self.layout = layout
        self.width = layout.width
        self.fold = layout.fold
        inputs = self.fold**2
        stem = []
        for outputs, kernel, stride in layout.stem:
            stem.append(_ConvBlock(inputs, outputs, kernel, stride, fused))
            inputs = outputs
        self.stem = nn.ModuleList(stem)
        blocks = [
            _Residual(inputs, layout.kernels, fused) for _ in range(layout.blocks)
        ]
        self.blocks = nn.ModuleList(blocks)
        self.project = nn.Conv2d(inputs, layout.width, 1)

    def forward(self, grey: Tensor) -> Tensor:
        """(b, 1, h, w) in [0, 1] -> (b, width, h // 8, w // 8) unit vectors."""
        height, width = (side // 8 * 8 for side in grey.shape[-2:])
        x = standardise(grey[..., :height, :width])
        x = F.pixel_unshuffle(x, self.fold).contiguous(
            memory_format=torch.channels_last
        )
        for layer in self.stem:
            x = F.relu(layer(x), inplace=True)
        for block in self.blocks:
            x = block(x)
        return F.normalize(self.project(x).float(), dim=1)

    def fuse(self) -> "LocalEncoder":
        """The same function with batch norm folded in, for inference."""
        trained = deepcopy(self).eval()
        twin = LocalEncoder(self.layout)
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


def onnx_bytes(module: LocalEncoder) -> bytes:
    """A fused encoder as an ONNX file, weights in half precision.

    The file is the convolutional part: its input (b, 1, h, w) is standardised, its output
    (b, width, h // 8, w // 8) is not normalised. OpenCV's classic engine has no operators for that.
    """
    nodes = []
    weights = []

    def node(kind: str, inputs: list[str], **attributes: Any) -> str:
        name = f"{kind.lower()}{len(nodes)}"
        nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def convolved(x: str, conv: nn.Conv2d, relu: bool = True) -> str:
        names = [x]
        for kind in ("weight", "bias"):
            values = getattr(conv, kind).detach().numpy().astype(np.float16)
            names.append(f"{kind}{len(weights)}")
            weights.append(numpy_helper.from_array(values, names[-1]))
        pads = [*cast(tuple[int, int], conv.padding)] * 2
        x = node(
            "Conv", names, kernel_shape=conv.kernel_size, strides=conv.stride, pads=pads
        )
        return node("Relu", [x]) if relu else x

    x = node("SpaceToDepth", ["grey"], blocksize=module.fold)
    for layer in module.stem:
        x = convolved(x, cast(Any, layer)[0])
    for block in module.blocks:
        y = x
        layers = [layer[0] for layer in cast(Any, block).layers]
        for conv in layers:
            y = convolved(y, conv, conv is not layers[-1])
        x = node("Relu", [node("Add", [y, x])])
    x = convolved(x, module.project, relu=False)
    ends = [("grey", ["b", 1, "h", "w"]), (x, ["b", module.width, "rows", "columns"])]
    one, other = (
        helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in ends
    )
    graph = helper.make_graph(nodes, "encoder", [one], [other], weights)
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9
    )
    onnx.checker.check_model(model)
    return model.SerializeToString()


def from_onnx(path: Path, layout: Layout) -> LocalEncoder:
    """Load the weights of a file of `onnx_bytes` into a fused module."""
    values = [numpy_helper.to_array(w) for w in onnx.load(path).graph.initializer]
    module = LocalEncoder(layout)
    state = module.state_dict()
    named = zip(state, values, strict=True)
    module.load_state_dict(
        {name: torch.from_numpy(value.copy()).float() for name, value in named}
    )
    return module.eval()
