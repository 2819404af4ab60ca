"""`evercal simulate`."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.errors import InputError


@dataclass(frozen=True)
class Simulate:
    """Render photorealistic rooms with a robot arm, poses and depth; this needs evercal[sim]."""

    suite: Annotated[Positional[Literal["sim", "sim-7", "sim-12", "sim-mini"]], arg(name="SUITE")]
    """Three rooms (sim), seven, twelve, or the three small ones that are shipped (sim-mini)."""
    out: Annotated[Path, arg(metavar="DIR")]
    """New folder for the scenes; the same command continues a run that was cut off."""
    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Frames of each room, training and test together; the suite's own number when left out."""
    size: Annotated[str | None, arg(metavar="WxH", help_behavior_hint="")] = None
    """Image size in pixels, such as 640x480; the suite's own when left out."""
    seed: int = 0
    """Seed of the camera paths and the noise; the rooms of a suite stay the same."""
    samples: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Paths per pixel: more is slower and truer in fine detail; the suite's own when left out."""
    exposure_ev: float = 0.0
    """Exposure in stops: above 0 is brighter, below 0 is darker."""
    noise: float = 0.0
    """Sensor noise as a share of full scale; a good camera has 0.01."""
    blur_steps: int = 1
    """How many poses a frame has while the shutter is open; with 1 there is no motion blur."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Renders what is missing."""
        from evercal.simulation.cell import SUITES, SimulateOptions, simulate

        began = time.perf_counter()
        options = SimulateOptions(
            self.frames,
            _size(self.size),
            self.seed,
            self.samples,
            self.exposure_ev,
            self.noise,
            self.blur_steps,
        )
        with progress_bar("rendering", 0, "frame") as bar:
            for progress in simulate(self.suite, self.out, options):
                if not bar.total:
                    bar.write(f"rendering with {progress.renderer}", file=sys.stderr)
                    bar.total = progress.total
                bar.update(progress.done - bar.n)
        scenes = [str(self.out / name) for name, _, _ in SUITES[self.suite].rooms]
        if self.json:
            seconds = time.perf_counter() - began
            print_json({"scenes": scenes, "frames": bar.n, "seconds": seconds})
        else:
            print_next("evercal", "inspect", scenes[0])
        return 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise InputError(f"size {text!r} is not WIDTHxHEIGHT in pixels, such as 640x480")
    return int(width), int(height)
