"""Training on several processes (torchrun), each with a share of every batch.

All processes start with the weights of the first, draw the same rows from the same seed and train
on their own share. Gradients are averaged, so all have the same weights at every step. Each view is
encoded by one process and its rows are sent to all.

Processes on GPUs communicate by NCCL, which sends CUDA tensors, the others by gloo, which sends CPU
tensors. Tensors elsewhere are copied.
"""

import atexit
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeVar

import torch
from torch import Tensor, distributed

from evercal.errors import InputError
from evercal.features.device import device_of

Work = TypeVar("Work")
Value = TypeVar("Value")


def processes() -> int:
    """Return the number of processes that train together."""
    return distributed.get_world_size() if _initialized() else 1


def rank() -> int:
    """Return the number of this process, from 0."""
    return distributed.get_rank() if _initialized() else 0


def join_processes(device: str | torch.device = "auto") -> torch.device:
    """Join the process group that torchrun started; without torchrun, only select a device.

    On CUDA each process of a machine uses the device of its LOCAL_RANK.

    Returns:
        The device of this process.

    Raises:
        InputError: The device does not exist, or the machine has fewer devices than processes.
    """
    own = device_of(device)
    if not distributed.is_available() or not distributed.is_torchelastic_launched():
        return own
    if own.type == "cuda":
        local, count = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local >= count:
            raise InputError(
                f"torchrun: process {local + 1} of this machine has no CUDA device of its own;"
                f" PyTorch finds {count}, so pass --nproc-per-node {count}"
            )
        own = torch.device("cuda", local)
        torch.cuda.set_device(own)
    if not _initialized():
        if own.type == "cuda":
            distributed.init_process_group("nccl", device_id=own)
        else:
            distributed.init_process_group("gloo")
        atexit.register(_leave)
    return own


def _leave() -> None:
    """Leave the group at the end of the process: NCCL warns about groups that are left open."""
    if _initialized():
        distributed.destroy_process_group()


@torch.no_grad()
def average(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor by its mean over the processes, in one exchange per type."""

    def mean(flat: Tensor) -> None:
        distributed.all_reduce(flat)
        flat /= processes()

    _exchange(tensors, mean)


@torch.no_grad()
def broadcast(tensors: Iterable[Tensor]) -> None:
    """Replace each tensor by that of the first process, in one exchange per type."""
    _exchange(tensors, lambda flat: distributed.broadcast(flat, 0))


def _exchange(tensors: Iterable[Tensor], exchange: Callable[[Tensor], object]) -> None:
    """Concatenate the tensors of each type, exchange them in place and copy them back."""
    if processes() == 1:
        return
    by_type: dict[torch.dtype, list[Tensor]] = {}
    for tensor in tensors:
        by_type.setdefault(tensor.dtype, []).append(tensor)
    for group in by_type.values():
        flat = torch.cat([tensor.detach().flatten() for tensor in group]).to(_exchange_device())
        exchange(flat)
        pieces = flat.split([tensor.numel() for tensor in group])
        for tensor, piece in zip(group, pieces, strict=True):
            tensor.detach().copy_(piece.view_as(tensor))


def shared_out(work: Sequence[Work], number: int, count: int) -> list[Work | None]:
    """Select the work of process `number` of `count`: one piece per round, None at the end.

    In round r, process k gets piece r count + k. All processes have the same number of rounds, so
    they can exchange results after each.
    """
    padded = [*work, *[None] * (-len(work) % count)]
    return padded[number::count]


def gather(part: Mapping[str, Tensor] | None) -> list[dict[str, Tensor]]:
    """Collect the named CPU tensors of all processes in order, without loss."""
    if processes() == 1:
        return [] if part is None else [dict(part)]
    received: list[dict[str, Tensor] | None] = [None] * processes()
    distributed.all_gather_object(received, part)
    return [tensors for tensors in received if tensors is not None]


def of_first(value: Value) -> Value:
    """Return the first process's value in all of them."""
    if processes() == 1:
        return value
    received: list[Value | None] = [None] * processes()
    distributed.all_gather_object(received, value if rank() == 0 else None)
    return received[0]  # pyright: ignore[reportReturnType]  # a list of one type


def wait_for_all() -> None:
    """Block until every process has called this."""
    if _initialized():
        device = _exchange_device()
        distributed.barrier(device_ids=[device.index] if device.type == "cuda" else None)


def _exchange_device() -> torch.device:
    """Return the device from which the backend sends tensors."""
    if distributed.get_backend() == "nccl":
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")


def _initialized() -> bool:
    return distributed.is_available() and distributed.is_initialized()
