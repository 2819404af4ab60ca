"""The option --device of all verbs."""

from typing import Annotated, Literal

from tyro.conf import arg

Device = Annotated[
    Literal["auto", "cpu", "cuda"],
    arg(help="Device of the encoder and networks; auto uses a CUDA device if there is one."),
]
