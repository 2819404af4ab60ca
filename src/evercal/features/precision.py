"""Mixed precision where it is fast: bfloat16 on CPUs and GPUs that multiply it in hardware."""

from functools import lru_cache

import torch


@lru_cache(maxsize=1)
def fast_bfloat16() -> bool:
    """Whether this CPU has bfloat16 products (AVX512-BF16, AMX, or Arm's BF16)."""
    try:
        return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except (AttributeError, RuntimeError):
        return False


def autocast(device: str = "cpu") -> torch.autocast:
    """Mixed precision on `device`, or plain fp32 where that would be slower."""
    enabled = device != "cpu" or fast_bfloat16()
    return torch.autocast(device, torch.bfloat16, enabled=enabled)
