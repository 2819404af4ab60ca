"""Precision of the networks' products: float32, or bfloat16 where the hardware multiplies it.

By default the hardware decides, so two machines can differ in the last digits of features, and
thereby of poses. `EVERCAL_PRECISION` sets it: `float32` gives the same arithmetic on every machine,
`bfloat16` is faster, `auto` is the default. With `float32`, the command line also fixes the kernels
of matrix products; a Python program sets OPENBLAS_CORETYPE=Haswell and MKL_CBWR=COMPATIBLE itself.
"""

import os
from functools import lru_cache

import torch

from evercal.errors import InputError

VARIABLE = "EVERCAL_PRECISION"
"""Name of the environment variable."""
AUTO = "auto"
"""The hardware decides."""
BFLOAT16 = "bfloat16"
"""Products in bfloat16 on every machine."""
FLOAT32 = "float32"
"""Products in float32 on every machine."""


def fast_bfloat16(device: torch.device | str = "cpu") -> bool:
    """Whether products on a device are calculated in bfloat16."""
    precision = os.environ.get(VARIABLE) or AUTO
    if precision not in (AUTO, BFLOAT16, FLOAT32):
        raise InputError(
            f"{VARIABLE}: {precision!r} is not a precision; set it to auto, bfloat16 or float32"
        )
    return precision == BFLOAT16 or (
        precision == AUTO and has_bfloat16(torch.device(device).type)
    )


@lru_cache(maxsize=4)
def has_bfloat16(kind: str) -> bool:
    """Whether a device has bfloat16 products: AVX512-BF16, AMX, Arm's BF16, CUDA from Ampere."""
    if kind == "cuda":
        return torch.cuda.is_available() and torch.cuda.is_bf16_supported(False)
    try:
        return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except (AttributeError, RuntimeError):
        return False


def autocast(device: torch.device | str = "cpu") -> torch.autocast:
    """Mixed precision for tensors on a device, or float32 where `fast_bfloat16` is false."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16, enabled=fast_bfloat16(kind))
