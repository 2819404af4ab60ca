"""Detect tensors on the wrong device on a machine without a GPU.

torch's `meta` device replaces the GPU: its tensors have shapes and no numbers. Many kernels accept
a `meta` tensor beside one of the CPU, so every operation is checked here.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

META = torch.device("meta")
_COPIES = (torch.ops.aten._to_copy, torch.ops.aten.to, torch.ops.aten.copy_)


class OneDevice(TorchDispatchMode):
    """Raise if an operation takes tensors of two devices, as CUDA does.

    Copies and scalars of the CPU are allowed.
    """

    def __torch_dispatch__(
        self, func: Any, types: Iterable[type], args: Any = (), kwargs: Any = None
    ) -> Any:
        tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
        devices = {t.device for t in tensors if t.dim() or t.device.type != "cpu"}
        if len(devices) > 1 and func.overloadpacket not in _COPIES:
            raise AssertionError(f"{func}: tensors on {sorted(map(str, devices))}")
        return func(*args, **(kwargs or {}))


@contextmanager
def tensors_stay_on_their_device() -> Iterator[None]:
    """Create tensors without a named device on `meta`, while all inputs are on the CPU.

    Any operation on such a tensor and an input raises, and its values cannot be read.
    """
    with META, OneDevice():
        yield
