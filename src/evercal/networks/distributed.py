"""One training on several processes (torchrun): each takes a share of every batch.

All draw the same rows from the same seed and keep their own; gradients are averaged over processes,
so that all hold the same weights at every step.
"""

from collections.abc import Iterable

import torch
from torch import Tensor, distributed

from evercal.networks.buffer import Rows


def processes() -> int:
    """How many processes train together; 1 without torch.distributed."""
    return distributed.get_world_size() if _together() else 1


def rank() -> int:
    """Which of them this is."""
    return distributed.get_rank() if _together() else 0


def own_share(rows: Rows) -> Rows:
    """The rows of a batch that this process trains on, as many as every other's."""
    count = processes()
    if count == 1:
        return rows
    whole = len(rows.scene) // count * count
    return rows.part(slice(rank(), whole, count))


def average(tensors: Iterable[Tensor]) -> None:
    """Replaces each tensor by its mean over the processes."""
    count = processes()
    if count == 1:
        return
    for tensor in tensors:
        distributed.all_reduce(tensor)
        tensor /= count


def wait_for_all() -> None:
    """Returns when every process has come here."""
    if _together():
        distributed.barrier()


def _together() -> bool:
    return distributed.is_available() and distributed.is_initialized()


def join_processes() -> None:
    """Joins the processes that torchrun started; nothing without torchrun."""
    if distributed.is_available() and distributed.is_torchelastic_launched() and not _together():
        distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
