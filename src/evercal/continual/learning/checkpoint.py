"""A training that is seen and survives: its checkpoint, its curve in a CSV, and TensorBoard."""

import hashlib
import inspect
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from pickle import UnpicklingError
from time import monotonic
from typing import Any

import torch

from evercal.continual.methods.method import Method
from evercal.continual.networks.trainer import HeadTrainer, Progress
from evercal.storage.atomic import replacing, write_bytes

CHECKPOINT = "checkpoint.pt"
"""File of the state of a training."""
CURVE = "training.csv"
"""File of the curve of a training."""
COLUMNS = ("step", "loss", "inlier_share", "rate")
"""Columns of the curve."""
EVERY_S = 60.0
"""Time between two checkpoints, seconds."""
_ROWS = 200
"""Rows of a curve, about."""
_KEY_ROWS = 1024
"""Rows of every buffer that a checkpoint depends on."""


def trained(
    trainer: HeadTrainer, method: Method, folder: Path | None
) -> Iterator[Progress]:
    """Train to the end, yielding after every step; go on from the checkpoint in a folder, if given.

    The result is that of a training without a stop. A checkpoint of another training is ignored.
    """
    if not folder:
        yield from trainer.run()
        return
    key = _key(trainer, method)
    curve = _resumed(trainer, key, folder / CHECKPOINT)
    board = _board(folder, trainer.step)
    saved = monotonic()
    for progress in trainer.run():
        step = progress.step
        last = step == progress.total
        if last or step % max(1, progress.total // _ROWS) == 0:
            row = (step, progress.loss, progress.inlier_share, progress.rate)
            curve.append(row)
            for name, value in zip(COLUMNS, row, strict=True):
                if board:
                    board.add_scalar(name, value, step)
        if last or monotonic() - saved > EVERY_S:
            state = {"key": key, "curve": curve, "trainer": trainer.state_dict()}
            with suppress(OSError):  # usually a full disk
                lines = [",".join(map(str, row)) for row in (COLUMNS, *curve)]
                write_bytes(folder / CURVE, "\n".join(lines).encode())
                if not last:  # who goes on has a step to report
                    with replacing(folder / CHECKPOINT) as file:
                        torch.save(state, file)
            saved = monotonic()
        yield progress


def _resumed(trainer: HeadTrainer, key: str, checkpoint: Path) -> list[Any]:
    """Go on from a checkpoint, if it is one of this training; the curve until then."""
    with suppress(OSError, RuntimeError, EOFError, UnpicklingError):
        state = torch.load(checkpoint, trainer.head.device, weights_only=True)
        if state["key"] == key:
            trainer.load_state_dict(state["trainer"])
            return state["curve"]
    return []


def _key(trainer: HeadTrainer, method: Method) -> str:
    """Digest of what decides a training: options, code of the method, first weights, some rows."""
    decides = [
        version("evercal"),
        torch.__version__,
        trainer.options,
        trainer.seed,
        method,
    ]
    for part in (method, trainer.hooks, *vars(method).values()):
        # Numbers have no source, nor has a method that was typed in.
        with suppress(OSError, TypeError, KeyError):
            decides.append(inspect.getsource(sys.modules[type(part).__module__]))
    key = hashlib.blake2b(repr(decides).encode(), digest_size=16)
    values = list(trainer.head.state_dict().values())
    for buffer in trainer.buffers:
        rows = buffer.draw(_KEY_ROWS, torch.Generator().manual_seed(0))
        target = rows.target
        values += [rows.features, rows.descriptor, rows.known, target.pixels]
        values += [target.camera_from_atlas, target.intrinsics]
    for value in values:
        key.update(value.numpy(force=True))
    return key.hexdigest()


def _board(folder: Path, step: int) -> Any:
    """A writer of TensorBoard, which replaces later steps; None where it is not installed."""
    with suppress(ImportError):
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(folder), purge_step=step)
