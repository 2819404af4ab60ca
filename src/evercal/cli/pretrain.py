"""`evercal pretrain`."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from evercal.cli.console import print_json, print_next


@dataclass(frozen=True)
class Pretrain:
    """Train the encoder and the descriptor on procedural images (hours).

    Example: evercal pretrain --out weights/
    """

    out: Annotated[Path, arg(metavar="FOLDER")]
    """Output folder of encoder.safetensors, descriptor.safetensors and pretrain.log."""
    work: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Folder of checkpoints, from which the same command resumes. Default: OUT/work."""
    json: bool = False
    """Print one JSON object."""


def pretrain_with_options() -> type:
    """Return the verb with the training options, whose module imports torch."""
    from evercal.continual.pretraining.contrastive import PretrainOptions

    @dataclass(frozen=True)
    class PretrainWithOptions(Pretrain):
        options: Annotated[PretrainOptions, arg(name="")] = field(default_factory=PretrainOptions)
        """Training options."""

        def run(self) -> int:
            """Train; the log is printed to stderr."""
            from evercal.continual.pretraining.make import pretrain

            began = time.perf_counter()
            pretrain(self.out, self.work or self.out / "work", self.options)
            encoder = self.out / "encoder.safetensors"
            if self.json:
                seconds = time.perf_counter() - began
                print_json({"encoder": str(encoder), "seconds": seconds})
            else:
                print_next("evercal", "learn", "STORE", "SCENE", "--encoder", encoder)
            return 0

    PretrainWithOptions.__doc__ = Pretrain.__doc__
    return PretrainWithOptions
