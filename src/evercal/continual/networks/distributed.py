"""One training on several processes (torchrun): each takes a share of every batch.

All start with the weights of the first, draw the same rows from the same seed and keep their own;
gradients are averaged over processes, so that all hold the same weights at every step. Views are
shared out too: each is encoded by one process, and all end with all rows.

On GPUs the processes talk by NCCL, which carries CUDA tensors, else by gloo, which carries tensors
of the CPU; tensors that lie elsewhere are copied there and back.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

import torch
from torch import Tensor, distributed

from evercal.errors import InputError
from evercal.features.device import device_of

Work = TypeVar("Work")


def processes() -> int:
    """How many processes train together; 1 without torch.distributed."""
    return distributed.get_world_size() if _together() else 1


def rank() -> int:
    """Which of them this is."""
    return distributed.get_rank() if _together() else 0


def join_processes(device: str | torch.device = "auto") -> torch.device:
    """Joins the processes that torchrun started; nothing to join without torchrun.

    Args:
        device: what the networks shall run on, see `device_of`. On CUDA each process of a machine
            takes the device of its LOCAL_RANK.

    Returns:
        The device of this process.

    Raises:
        InputError: no such device, or fewer of them on this machine than processes.
    """
    found = device_of(device)
    if not distributed.is_available() or not distributed.is_torchelastic_launched():
        return found
    if found.type == "cuda":
        local, count = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if local >= count:
            raise InputError(
                f"torchrun: process {local + 1} of this machine finds {count} CUDA devices; give"
                f" --nproc-per-node {count}"
            )
        found = torch.device("cuda", local)
        torch.cuda.set_device(found)
    if not _together():
        if found.type == "cuda":
            distributed.init_process_group("nccl", device_id=found)
        else:
            distributed.init_process_group("gloo")
    return found


@torch.no_grad()
def average(tensors: Iterable[Tensor]) -> None:
    """Replaces each tensor by its mean over the processes; all travel as one."""
    count = processes()
    if count == 1:
        return
    for some, flat in _flattened(tensors):
        distributed.all_reduce(flat)
        flat /= count
        _copy_back(flat, some)


@torch.no_grad()
def broadcast(tensors: Iterable[Tensor]) -> None:
    """Replaces each tensor by that of the first process, to its last bit; all travel as one.

    Args:
        tensors: parameters and buffers, in the same order and of the same shapes everywhere.
    """
    if processes() == 1:
        return
    for some, flat in _flattened(tensors):
        distributed.broadcast(flat, 0)
        _copy_back(flat, some)


def _flattened(tensors: Iterable[Tensor]) -> list[tuple[list[Tensor], Tensor]]:
    """Tensors by type, and all numbers of a type in one row that the processes can exchange."""
    by_type: dict[torch.dtype, list[Tensor]] = {}
    for tensor in tensors:
        by_type.setdefault(tensor.dtype, []).append(tensor)
    carrier = _carrier()
    return [
        (some, torch.cat([tensor.detach().flatten() for tensor in some]).to(carrier))
        for some in by_type.values()
    ]


def _copy_back(flat: Tensor, tensors: Sequence[Tensor]) -> None:
    pieces = flat.split([tensor.numel() for tensor in tensors])
    for tensor, piece in zip(tensors, pieces, strict=True):
        tensor.detach().copy_(piece.view_as(tensor))


def shared_out(work: Sequence[Work], number: int, count: int) -> list[Work | None]:
    """What one of several processes does, round by round; None where nothing is left for it.

    In round r, process k does piece r count + k. All have the same number of rounds, so that they
    can exchange what they made after each.

    Args:
        work: all there is to do.
        number: which process.
        count: how many there are.
    """
    rounds = -(-len(work) // count)
    places = [turn * count + number for turn in range(rounds)]
    return [work[place] if place < len(work) else None for place in places]


def gather(part: Mapping[str, Tensor] | None) -> list[dict[str, Tensor]]:
    """What all processes made, in the order of their numbers, to the last bit.

    Args:
        part: named tensors of this process, any shapes, on the CPU; None if it made nothing.
    """
    count = processes()
    if count == 1:
        return [] if part is None else [dict(part)]
    from safetensors.torch import load, save

    carrier = _carrier()
    own = b"" if part is None else save({k: v.contiguous() for k, v in part.items()})
    length = torch.tensor([len(own)], device=carrier)
    lengths = [torch.zeros_like(length) for _ in range(count)]
    distributed.all_gather(lengths, length)
    sizes = [int(size) for size in lengths]
    sent = torch.zeros(max(sizes), dtype=torch.uint8, device=carrier)
    if own:
        sent[: len(own)] = torch.frombuffer(bytearray(own), dtype=torch.uint8)
    received = [torch.empty_like(sent) for _ in range(count)]
    distributed.all_gather(received, sent)
    return [
        load(data[:size].cpu().numpy().tobytes())
        for data, size in zip(received, sizes, strict=True)
        if size
    ]


def wait_for_all() -> None:
    """Returns when every process has come here."""
    if _together():
        carrier = _carrier()
        distributed.barrier(device_ids=[carrier.index] if carrier.type == "cuda" else None)


def _carrier() -> torch.device:
    """Where tensors must lie that the processes exchange."""
    if distributed.get_backend() == "nccl":
        return torch.device("cuda", torch.cuda.current_device())
    return torch.device("cpu")


def _together() -> bool:
    return distributed.is_available() and distributed.is_initialized()
