"""Peak memory of this process."""

import resource
import sys

import torch


def peak_gb(device: torch.device) -> float:
    """Return the peak memory in gigabytes: of a CUDA device, otherwise resident memory."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    unit = 1 if sys.platform == "darwin" else 1024  # Linux counts kibibytes, macOS bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
