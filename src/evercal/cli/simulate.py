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
    """Render furnished rooms with a robot arm, poses and depth; needs the extra `sim`.

    Example: evercal simulate sim-mini --out rooms/
    """

    suite: Annotated[
        Positional[Literal["sim", "sim-7", "sim-12", "sim-mini", "sim-repeat"]], arg(name="SUITE")
    ]
    """Rooms to render: three (sim), seven, twelve, the three packaged ones (sim-mini), or three
    with repeated textures and objects (sim-repeat)."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Output folder. The same command continues an interrupted run."""
    frames: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Training and test frames of each room; default: as the suite defines."""
    size: Annotated[str | None, arg(metavar="WxH", help_behavior_hint="")] = None
    """Image size in pixels, such as 640x480; default: as the suite defines."""
    seed: int = 0
    """Seed of the camera paths and the noise. Rooms do not depend on it."""
    samples: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Light paths per pixel; more is slower and more exact. Default: as the suite defines."""
    exposure_ev: float = 0.0
    """Exposure in stops; positive is brighter."""
    noise: float = 0.0
    """Sensor noise as a fraction of full scale; a good camera has 0.01."""
    blur_steps: int = 1
    """Camera poses per exposure; 1 disables motion blur."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Render the missing frames."""
        from evercal.simulation.cell import SUITES, SimulateOptions, simulate

        began = time.perf_counter()
        options = SimulateOptions(
            frames=self.frames,
            size=_size(self.size),
            seed=self.seed,
            samples=self.samples,
            exposure_ev=self.exposure_ev,
            noise=self.noise,
            blur_steps=self.blur_steps,
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
        raise InputError(f"--size {text}: give WIDTHxHEIGHT in pixels, such as 640x480")
    return int(width), int(height)
