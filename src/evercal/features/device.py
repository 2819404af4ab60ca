"""Which device the networks run on: decided here and nowhere else."""

from itertools import chain

import torch
from torch import nn

from evercal.errors import InputError

DEVICES = ("auto", "cpu", "cuda")


def device_of(wanted: str | torch.device = "auto") -> torch.device:
    """The device that a word means.

    Args:
        wanted: `auto` (the CUDA device of this process where there is one, else the CPU), `cpu`,
            `cuda`, or `cuda:1` for a certain one.

    Returns:
        A device with its number, so that it equals the `device` of tensors that lie there.

    Raises:
        InputError: another word, or a CUDA device that is not there.
    """
    word = str(wanted)
    if word == "cpu" or (word == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    kind, colon, number = word.partition(":")
    if word != "auto" and (kind != "cuda" or (colon and not number.isdecimal())):
        raise InputError(f"device {word!r}: there is no such device; take auto, cpu or cuda")
    if not torch.cuda.is_available():
        raise InputError(
            f"device {word!r}: PyTorch {torch.__version__} finds no CUDA device on this machine;"
            " take auto or cpu"
        )
    index = int(number) if number else torch.cuda.current_device()
    if index >= torch.cuda.device_count():
        raise InputError(
            f"device {word!r}: this machine has {torch.cuda.device_count()} CUDA devices, counted"
            " from 0; take one of these"
        )
    return torch.device("cuda", index)


def device_of_network(network: object) -> torch.device:
    """Where the weights of a network lie; the CPU for one that has none."""
    if isinstance(network, nn.Module):
        for value in chain(network.parameters(), network.buffers()):
            return value.device
    return torch.device("cpu")


def allow_tf32(device: torch.device) -> None:
    """Lets fp32 matrix products on a CUDA device round their factors to 10 bits; much faster there.

    For training: weights are stored with as many bits. Products that need all bits (points into a
    camera) are written as sums, so they keep them. On the CPU nothing changes.
    """
    if device.type == "cuda":
        torch.backends.cuda.matmul.allow_tf32 = True
        torch.backends.cudnn.allow_tf32 = True
