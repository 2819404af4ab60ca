"""Finds tensors on the wrong device on a machine that has only one.

torch's `meta` device stands in for a GPU: its tensors have shapes and no numbers. Many of torch's
own kernels take a `meta` tensor beside one of the CPU without a word, so every operation is checked
here.
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
    """Raises where an operation takes tensors of two devices, as CUDA would.

    Copies may, and single numbers of the CPU may go anywhere.
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
def made_where_inputs_lie() -> Iterator[None]:
    """Whatever is made without naming a device lies on `meta`; with inputs on the CPU it is found.

    It makes an operation raise, or has no numbers to give.
    """
    with META, OneDevice():
        yield
