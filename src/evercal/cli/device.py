"""The word that says what the networks run on, alike for every verb."""

from typing import Annotated, Literal

from tyro.conf import arg

Device = Annotated[
    Literal["auto", "cpu", "cuda"],
    arg(help="What networks run on; auto takes a CUDA device where there is one, else the CPU."),
]
