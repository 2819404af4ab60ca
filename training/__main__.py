"""`python -m training`: the encoder and the descriptor, from procedural images."""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import arg

from evercal.errors import InputError
from training.contrastive import PretrainOptions
from training.make import pretrain


def run(
    out: Path,
    options: Annotated[PretrainOptions, arg(name="")] = PretrainOptions(),  # noqa: B008
    work: Path | None = None,
) -> None:
    """Train the encoder and the descriptor on procedural images (hours).

    Args:
        out: Output folder of encoder.onnx, descriptor.safetensors and pretrain.log.
        options: Training options.
        work: Folder of checkpoints, from which the same command resumes. Default: OUT/work.
    """
    pretrain(out, work or out / "work", options)


def main(args: list[str]) -> int:
    """Train with the options of the command line and return the exit code."""
    try:
        tyro.cli(run, args=args, prog="python -m training")
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
