"""Seeded random numbers of torch, on the CPU."""

import torch
from torch import Generator, Tensor


def seeded(seed: int) -> Generator:
    """A generator with a seed."""
    return Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    """Normal numbers, the same for the same seed."""
    return torch.randn(*shape, generator=seeded(seed), device="cpu")
