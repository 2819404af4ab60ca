"""The device that the networks run on."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain

import torch
from torch import nn

from evercal.errors import InputError


def device_of(name: str | torch.device = "auto") -> torch.device:
    """The device of a name, numbered, so that it equals the `device` of its tensors.

    Names are `auto` (the current CUDA device if there is one, otherwise the CPU), `cpu`, `cuda`, or
    a numbered device such as `cuda:1`.
    """
    word = str(name)
    if word == "cpu" or (word == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    kind, colon, number = word.partition(":")
    if word != "auto" and (kind != "cuda" or (colon and not number.isdecimal())):
        raise InputError(f"device {word!r}: not a device; use auto, cpu or cuda")
    if not torch.cuda.is_available():
        raise InputError(
            f"device {word!r}: PyTorch {torch.__version__} finds no CUDA device on this machine;"
            " use auto or cpu"
        )
    index = int(number or torch.cuda.current_device())
    if index >= torch.cuda.device_count():
        raise InputError(
            f"device {word!r}: this machine has {torch.cuda.device_count()} CUDA devices, counted"
            " from 0; use one of them"
        )
    return torch.device("cuda", index)


def device_of_network(network: nn.Module) -> torch.device:
    """Device of the weights of a network; the CPU for a network without weights."""
    for value in chain(network.parameters(), network.buffers()):
        return value.device
    return torch.device("cpu")


@contextmanager
def tf32(device: torch.device) -> Iterator[None]:
    """Let fp32 matrix products on a CUDA device round their factors to 10 bits, which is faster.

    For training: weights are stored with 10 bits, too. Products that need all bits, such as points
    in a camera, are written as sums. Convolutions are rounded by default. On the CPU nothing
    changes.
    """
    if device.type != "cuda":
        yield
        return
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("high")
        yield
    finally:
        torch.set_float32_matmul_precision(before)
