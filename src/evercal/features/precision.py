"""Mixed precision where it is fast: bfloat16 on CPUs and GPUs that multiply it in hardware."""

from functools import lru_cache

import torch


def fast_bfloat16(device: torch.device | str = "cpu") -> bool:
    """Whether a device has bfloat16 products: AVX512-BF16, AMX, Arm's BF16, or CUDA from Ampere."""
    return _fast_bfloat16(torch.device(device).type)


@lru_cache(maxsize=4)
def _fast_bfloat16(kind: str) -> bool:
    if kind == "cuda":
        return torch.cuda.is_available() and torch.cuda.is_bf16_supported(False)
    try:
        return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except (AttributeError, RuntimeError):
        return False


def autocast(device: torch.device | str = "cpu") -> torch.autocast:
    """Mixed precision for tensors on `device`, or plain fp32 where that would be slower."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16, enabled=fast_bfloat16(kind))
