"""Features of images that were encoded before, for runs that see the same views again and again."""

import contextlib
import hashlib
import os
import shutil
import uuid
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn


def cache_features(encoder: nn.Module, folder: Path, limit_bytes: int | None = None) -> None:
    """Makes a frozen encoder look up what it has encoded before, and note what it has not.

    From then on features have half precision, found or not, so that results do not depend on what
    was encoded first. Files that cannot be read are made again; the folder may be deleted.

    Args:
        encoder: changed in place; its weights and type stay what they are.
        folder: where features are kept, one file per image; made when missing.
        limit_bytes: how much is added to the folder; beyond, features are found but no longer
            kept. When left out, half of what is free on the disk now stays free, also where others
            write to it. On a full disk nothing more is kept either.
    """
    weights = hashlib.blake2b(digest_size=8)
    for value in encoder.state_dict().values():
        weights.update(value.detach().cpu().float().numpy().tobytes())
    folder = folder / weights.hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    compute = encoder.forward
    half = shutil.disk_usage(folder).free // 2
    room, spare = (half, half) if limit_bytes is None else (limit_bytes, 0)

    def forward(grey: Tensor) -> Tensor:
        nonlocal room
        names = [_name(image) for image in grey]
        found = [_read(folder / name) for name in names]
        missing = [i for i, value in enumerate(found) if value is None]
        if missing:
            made = compute(grey[missing]).half().cpu()
            for i, value in zip(missing, made, strict=True):
                found[i] = value
                others = shutil.disk_usage(folder).free - spare
                if min(room, others) > value.nbytes:
                    room = room - value.nbytes if _written(folder / names[i], value) else 0
        whole = torch.stack([value.float() for value in found if value is not None])
        return whole.to(grey.device)

    encoder.forward = forward


def _name(image: Tensor) -> str:
    shape = "x".join(map(str, image.shape))
    digest = hashlib.blake2b(image.cpu().numpy().tobytes(), digest_size=16).hexdigest()
    # Another kind of device rounds otherwise: its features are its own.
    kind = "" if image.device.type == "cpu" else f"-{image.device.type}"
    return f"{shape}-{digest}{kind}.npy"


def _read(path: Path) -> Tensor | None:
    try:
        return torch.from_numpy(np.load(path))
    except (OSError, ValueError, EOFError):
        return None


def _written(path: Path, features: Tensor) -> bool:
    """Whether features could be kept."""
    # Whole or not at all, but not synced: what a power cut takes is made again.
    temporary = path.with_name(f".{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "wb") as file:
            np.save(file, features.contiguous().numpy())
        os.replace(temporary, path)
    except OSError:  # a full disk, as a rule
        with contextlib.suppress(OSError):
            temporary.unlink()
        return False
    return True
