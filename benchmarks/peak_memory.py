"""The most memory that this process held."""

import resource
import sys

import torch


def peak_gb(device: torch.device) -> float:
    """Gigabytes: of the GPU where the device is one, of the process's resident memory otherwise."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    unit = 1 if sys.platform == "darwin" else 1024  # Linux counts kibibytes, macOS bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
