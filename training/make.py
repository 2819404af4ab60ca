"""Pretraining from seeds to the weight files that the package ships."""

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from evercal.continual.networks.descriptor import descriptor_bytes
from evercal.storage.atomic import write_bytes
from training.contrastive import PretrainOptions, make_data, train_encoder
from training.network import onnx_bytes
from training.places import train_descriptor


def pretrain(out: Path, work: Path, options: PretrainOptions) -> None:
    """Write `encoder.onnx`, `descriptor.safetensors` and `pretrain.log`.

    Args:
        out: Folder of the three files; existing files are replaced.
        work: Folder of checkpoints. A run with the same options resumes from them.
        options: Training options.
    """
    out.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    path = work / "pretrain.log"
    began = time.perf_counter()

    def log(line: str) -> None:
        with path.open("a") as file:
            file.write(line + "\n")
        print(line, file=sys.stderr, flush=True)

    def seconds() -> str:
        return f"{time.perf_counter() - began:.0f} s"

    log(f"options {json.dumps(asdict(options))}")
    log(
        f"torch {torch.__version__} numpy {np.__version__} threads {torch.get_num_threads()}"
    )
    data = make_data(options, work)
    log(
        f"rendered {options.rooms} box rooms, {options.furnished} furnished rooms, "
        f"{options.pictures} pictures {seconds()}"
    )
    trained = train_encoder(data, options, work, log)
    encoder = trained.fuse().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    write_bytes(out / "encoder.onnx", onnx_bytes(encoder))
    descriptor = train_descriptor(data, options, encoder, log)
    write_bytes(out / "descriptor.safetensors", descriptor_bytes(descriptor))
    log(f"done {seconds()}")
    write_bytes(out / "pretrain.log", path.read_bytes())
