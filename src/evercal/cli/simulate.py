"""`evercal simulate`."""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.options import Count, Verb
from evercal.errors import InputError


@dataclass(frozen=True)
class Simulate(Verb):
    """Render furnished rooms with an arm (extra `sim`), or record a virtual robot cell.

    Example: evercal simulate cell --out cell/
    """

    suite: Annotated[
        Positional[
            Literal[
                "sim",
                "sim-7",
                "sim-12",
                "sim-mini",
                "sim-tune",
                "sim-unseen",
                "sim-repeat",
                "cell",
            ]
        ],
        arg(name="SUITE"),
    ]
    """Rooms to render: three (sim), seven, twelve, the three packaged ones (sim-mini), three for
    tuning networks (sim-tune), three for confirming them (sim-unseen), or three with repeated
    textures and objects (sim-repeat). cell: a wrist recording and images of a fixed camera, in
    seconds and without the extra."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Output folder. The same command continues an interrupted run."""
    frames: Count = None
    """Training and test frames of each room, or wrist images of a cell; default: as the suite
    defines."""
    size: Annotated[str | None, arg(metavar="WxH", help_behavior_hint="")] = None
    """Image size in pixels, such as 640x480; default: as the suite defines."""
    seed: int = 0
    """Seed of the camera paths and the noise, and of the whole cell. Rooms do not depend on it."""
    samples: Count = None
    """Light paths per pixel; more is slower and more exact. Default: as the suite defines."""
    exposure_ev: float = 0.0
    """Exposure in stops; positive is brighter."""
    noise: Annotated[float | None, arg(metavar="SHARE", help_behavior_hint="")] = None
    """Sensor noise as a fraction of full scale; a good camera has 0.01. Default: 0, cell 0.008."""
    blur_steps: int = 1
    """Camera poses per exposure; 1 disables motion blur."""
    sweep_only: bool = False
    """Render training and test frames only, without calibration recordings and changed frames. The
    same command without this option adds them."""

    def run(self) -> int:
        """Render the missing frames."""
        if self.suite == "cell":
            return self._record_cell()
        from evercal.simulation.cell import SUITES, SimulateOptions, simulate

        began = time.perf_counter()
        options = SimulateOptions(
            frames=self.frames,
            size=_size(self.size),
            seed=self.seed,
            samples=self.samples,
            exposure_ev=self.exposure_ev,
            noise=self.noise or 0.0,
            blur_steps=self.blur_steps,
            sweep_only=self.sweep_only,
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

    def _record_cell(self) -> int:
        if self.samples is not None or self.exposure_ev or self.blur_steps != 1 or self.sweep_only:
            raise InputError(
                "cell: takes no --samples, --exposure-ev, --blur-steps and --sweep-only; omit them"
            )
        from evercal.simulation.cell_recording import TRIPOD_IMAGES, WRIST_IMAGES, record_cell
        from evercal.simulation.virtual_cell import CellOptions

        began, frames = time.perf_counter(), WRIST_IMAGES if self.frames is None else self.frames
        options, size = CellOptions(), _size(self.size)
        if size is not None:
            options = replace(options, width=size[0], height=size[1])
        if self.noise is not None:
            options = replace(options, image_noise=self.noise)
        with progress_bar("recording", frames + TRIPOD_IMAGES, "image") as bar:
            for _ in record_cell(self.out, self.seed, frames, options):
                bar.update()
        if self.json:
            seconds = time.perf_counter() - began
            parts = {name: str(self.out / name) for name in ("wrist", "tripod", "truth.json")}
            print_json({"scenes": [parts["wrist"]], **parts, "frames": bar.n, "seconds": seconds})
        else:
            print_next("evercal", "learn", "STORE", self.out / "wrist")
        return 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size {text}: give WIDTHxHEIGHT in pixels, such as 640x480")
    return int(width), int(height)
