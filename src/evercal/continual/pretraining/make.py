"""One command from seeds to the weight files that the package ships."""

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from evercal.continual.pretraining.contrastive import PretrainOptions, make_data, train_encoder
from evercal.continual.pretraining.places import train_descriptor
from evercal.features.weights_file import network_bytes
from evercal.storage.atomic import write_bytes


def pretrain(out: Path, work: Path, options: PretrainOptions) -> None:
    """Makes `encoder.safetensors`, `descriptor.safetensors` and `pretrain.log` in `out`.

    Args:
        out: folder for the three files; files of these names are replaced.
        work: folder for checkpoints; the same options continue from what lies there.
        options: what to train.
    """
    out.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    log = work / "pretrain.log"

    def say(line: str) -> None:
        with log.open("a") as file:
            file.write(line + "\n")
        print(line, file=sys.stderr, flush=True)  # noqa: T201

    say(f"options {json.dumps(asdict(options))}")
    say(f"torch {torch.__version__} numpy {np.__version__} threads {torch.get_num_threads()}")
    began = time.perf_counter()
    data = make_data(options, work)
    say(
        f"rendered {options.rooms} box rooms, {options.furnished} furnished rooms, "
        f"{options.pictures} pictures {_since(began)}"
    )
    trained = train_encoder(data, options, work, say)
    encoder = trained.fuse().to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    write_bytes(out / "encoder.safetensors", network_bytes(encoder, "encoder"))
    descriptor = train_descriptor(data, options, encoder, say)
    write_bytes(out / "descriptor.safetensors", network_bytes(descriptor, "descriptor"))
    say(f"done {_since(began)}")
    write_bytes(out / "pretrain.log", log.read_bytes())


def _since(began: float) -> str:
    return f"{time.perf_counter() - began:.0f} s"
