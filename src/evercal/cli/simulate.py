"""`evercal simulate`."""

import re
from dataclasses import replace
from time import perf_counter
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.errors import InputError
from evercal.progress import progress_bar


@frozen
class Simulate(args.Verb):
    """Record a virtual robot cell: wrist camera, fixed camera, truth.

    Example: evercal simulate cell --out cell/
    """

    kind: Annotated[Positional[Literal["cell"]], arg(name="KIND")]
    """What is simulated: cell. Furnished rooms are rendered by 'python -m rooms' in a checkout."""
    out: args.OutFolder
    """Output folder, which is new or empty."""
    frames: args.Count = None
    """Images of the wrist camera. Default: 25."""
    size: Annotated[str | None, args.shown("WxH")] = None
    """Image size in pixels. Default: 640x480."""
    seed: int = 0
    """Seed of the cell, the motion and the noise."""
    noise: Annotated[float | None, args.shown("SHARE")] = None
    """Sensor noise as a fraction of full scale. Default: 0.008."""

    def run(self) -> int:
        from evercal.simulation import cell_recording as cell
        from evercal.simulation.virtual_cell import CellOptions

        began = perf_counter()
        options = CellOptions()
        frames = cell.WRIST_IMAGES if self.frames is None else self.frames
        if self.size is not None:
            size = re.fullmatch(r"(\d+)x(\d+)", self.size)
            if not size:
                raise InputError(
                    f"--size {self.size}: give WIDTHxHEIGHT in pixels, such as 640x480"
                )
            options = replace(options, width=int(size[1]), height=int(size[2]))
        if self.noise is not None:
            options = replace(options, image_noise=self.noise)
        images = frames + cell.TRIPOD_IMAGES + cell.HELD_IMAGES
        with progress_bar("recording", images, "image") as bar:
            for _ in cell.record_cell(self.out, self.seed, frames, options):
                bar.update()
        seconds = perf_counter() - began
        wrist = str(self.out / "wrist")
        record = {
            "scenes": [wrist],
            "wrist": wrist,
            "tripod": str(self.out / "tripod"),
            "held": str(self.out / "held"),
            "truth.json": str(self.out / "truth.json"),
            "frames": bar.n,
            "seconds": seconds,
        }
        counts = (
            f"{frames} wrist, {cell.TRIPOD_IMAGES} tripod and {cell.HELD_IMAGES} held"
        )
        line = f"wrote {self.out}: {counts} images, and what is true in truth.json"
        self.answer(record, line, then=("learn", "MAP", self.out / "wrist"))
        return 0
