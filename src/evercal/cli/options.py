"""Arguments that several verbs share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

Store = Annotated[Positional[Path], arg(metavar="MAP")]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
Name = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Frame = Annotated[str | None, arg(metavar="FRAME", help_behavior_hint="")]
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
Device = Annotated[
    Literal["auto", "cpu", "cuda"],
    arg(help="Device of the encoder and networks; auto uses a CUDA device if there is one."),
]


@dataclass(frozen=True, kw_only=True)
class Verb:
    """A verb with its arguments."""

    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Run and return the exit code."""
        raise NotImplementedError
