"""A device `gpu` that computes on the CPU: real numbers, and the errors of two devices.

Every tensor of the device is a wrapper around a CPU tensor. An operation unwraps its inputs, runs
on the CPU and wraps its outputs, so results equal those of the CPU bit for bit. As on CUDA, an
operation on tensors of both devices raises, except for copies, scalars and indices.

`register()` changes torch for the whole process and must run before the first backward pass. Tests
therefore run in a process of their own.
"""

from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._pytree import tree_leaves, tree_map

NAME = "gpu"
_COPIES = (torch.ops.aten._to_copy, torch.ops.aten.copy_, torch.ops.aten._copy_from)
_INDEXED = (torch.ops.aten.index, torch.ops.aten.index_put_, torch.ops.aten._index_put_impl_)
_VALUES: dict[int, tuple[Tensor, Any]] = {}
"""CPU tensors by the storage of their wrapper, which copies of a wrapper share. Storages are kept,
because the address of a freed one could be used again."""
_library = torch.library.Library("_", "IMPL")


class OnDevice(Tensor):
    """A tensor of the simulated device."""

    @staticmethod
    def __new__(cls, cpu: Tensor) -> "OnDevice":
        wrapper = Tensor._make_wrapper_subclass(  # pyright: ignore
            cls,
            cpu.size(),
            strides=cpu.stride(),
            storage_offset=cpu.storage_offset(),
            dtype=cpu.dtype,
            device=torch.device(NAME, 0),
        )
        storage = wrapper.untyped_storage()
        _VALUES[storage._cdata] = cpu, storage
        return wrapper

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, *args, **(kwargs or {}))

    __torch_function__ = torch._C._disabled_torch_function_impl  # pyright: ignore

    def tolist(self) -> Any:
        """The numbers; torch reads them from memory that a wrapper does not have."""
        return values(self).tolist()

    def numpy(self, **_: Any) -> Any:
        """Refused, as for CUDA."""
        raise TypeError("can't convert a tensor of another device to numpy; use Tensor.cpu()")


def values(tensor: Tensor) -> Tensor:
    """The CPU tensor of a wrapper."""
    return _VALUES[tensor.untyped_storage()._cdata][0]


def _run(func: Any, *args: Any, **kwargs: Any) -> Any:
    """Run an operation on the CPU tensors of its arguments."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    packet = getattr(func, "overloadpacket", None)
    mine = any(isinstance(t, OnDevice) for t in tensors)
    asked = torch.device(kwargs["device"]) if kwargs.get("device") is not None else None
    strangers = [t for t in tensors if not isinstance(t, OnDevice) and t.dim()]
    if mine and strangers and packet not in _COPIES + _INDEXED:
        raise RuntimeError(f"{func}: tensors on {NAME} and on the CPU")
    inner = {id(values(t)): t for t in tensors if isinstance(t, OnDevice)}

    def unwrapped(leaf: Any) -> Any:
        if isinstance(leaf, OnDevice):
            return values(leaf)
        return torch.device("cpu") if isinstance(leaf, torch.device) else leaf

    def rewrapped(leaf: Any) -> Any:
        if not isinstance(leaf, Tensor) or isinstance(leaf, OnDevice):
            return leaf
        if id(leaf) not in inner:
            return OnDevice(leaf)
        before = inner[id(leaf)]
        if before.size() != leaf.size():  # squeeze_ and the like
            before.data = OnDevice(leaf)
        return before

    args, kwargs = tree_map(unwrapped, (args, kwargs))
    result = func(*args, **kwargs)
    if packet is torch.ops.aten.copy_:
        return tensors[0]
    if packet is torch.ops.aten._copy_from:
        return tensors[1]
    here = asked.type == NAME if asked is not None else mine
    return tree_map(rewrapped, result) if here else result


class _Module:
    """What torch asks of a module `torch.gpu`."""

    @staticmethod
    def is_available() -> bool:
        return True

    @staticmethod
    def is_initialized() -> bool:
        return True

    @staticmethod
    def device_count() -> int:
        return 1

    @staticmethod
    def current_device() -> int:
        return 0

    @staticmethod
    def get_amp_supported_dtype() -> list[torch.dtype]:
        return [torch.bfloat16]

    @staticmethod
    def _is_in_bad_fork() -> bool:
        return False

    @staticmethod
    def manual_seed_all(seed: int) -> None:
        del seed


class _Generator(torch.Generator):
    """A generator of the CPU, whichever device it is made for."""

    def __new__(cls, device: object = "cpu") -> "_Generator":
        del device
        return super().__new__(cls, "cpu")  # pyright: ignore


_tensor = torch.tensor


def _tensor_on(data: Any, *, device: Any = None, **options: Any) -> Tensor:
    """`torch.tensor`, which has no Python kernel."""
    made = _tensor(data, **options)
    return made if device is None else made.to(device)


def _without_gradients(mode: Any) -> None:
    """Enter inference mode as `no_grad`: a wrapper has no version counter to leave out."""
    mode.before = torch.is_grad_enabled()
    torch.set_grad_enabled(False)


def _as_before(mode: Any, *_: object) -> None:
    torch.set_grad_enabled(mode.before)


def register() -> torch.device:
    """Register the device, once a process, and return it."""
    setattr(torch.inference_mode, "__enter__", _without_gradients)  # noqa: B010
    setattr(torch.inference_mode, "__exit__", _as_before)  # noqa: B010
    backend_registration._setup_privateuseone_for_python_backend(NAME, _Module())
    _library.fallback(_run, "PrivateUse1")
    torch.Generator = _Generator
    torch.tensor = _tensor_on
    return torch.device(NAME, 0)
