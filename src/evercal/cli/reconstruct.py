"""`evercal reconstruct`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.progress import Bars

_CONNECTED = 0.8
"""Share of the frames that connect, below which a reconstruction has failed."""


@frozen
class Reconstruct(args.Verb):
    """Estimate camera poses from a plain video or images, for a map.

    The unit of length is arbitrary until 'evercal align'. Exit code 1 if less than 80 % of the
    frames connect.

    Example: evercal reconstruct phone.mp4 capture/
    """

    source: Annotated[Positional[Path], arg(metavar="VIDEO|DIR")]
    """Video file, or folder of images of one camera."""
    out: args.NewFolder
    """New folder: a COLMAP model and its images."""
    motion: Annotated[float, arg(metavar="SHARE")] = 0.04
    """Motion from one chosen frame of a video to the next, parts of its width."""
    most: args.Number = 300
    """Frames, at most."""

    def run(self) -> int:
        from evercal.recordings.reconstruct import reconstruct

        with Bars() as bars:
            model = reconstruct(
                self.source, self.out, self.motion, self.most, bars.step
            )
        whole = model.posed >= _CONNECTED * model.frames
        lines = [
            f"{self.out}: {model.posed} of {model.frames} frames have a pose, {model.points:,}"
            f" points, residual {model.residual_px:.2f} px"
        ]
        if not whole:
            lines.append(
                f"the video does not hold together: parts of {', '.join(map(str, model.parts))}"
                " frames; move more slowly where they end, and return to places seen before"
            )
        record = {"out": str(self.out), **dataclasses.asdict(model)}
        self.answer(record, *lines, then=("learn", "cell.evercal", self.out))
        return 0 if whole else 1
