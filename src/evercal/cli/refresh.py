"""`evercal refresh`."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import motion, size
from evercal.errors import InputError
from evercal.progress import Bars

if TYPE_CHECKING:
    from evercal.localization.refreshing import RefreshReport
    from evercal.recordings import Recording

_LISTED = 5
"""Images left out that are printed."""


@frozen
class Refresh(args.Verb):
    """Follow a changed room: new images replace what is gone.

    The map keeps its size. The images need no poses: they are located in the map. What was moved or
    removed leaves it, and the base frame stays where the unmoved keyframes hold it.

    Example: evercal refresh cell.evercal images/
    """

    writes = ("store",)
    store: args.Store
    images: Annotated[
        Positional[tuple[Path, ...]], args.shown("[RECORDING|IMAGE...]")
    ] = ()
    """Images of one camera, a folder of them, or a recording."""
    camera: args.File = None
    """File of the intrinsics. Default: those of the camera that recorded the scene."""
    undo: Annotated[str | None, args.shown("SCENE")] = None
    """Bring back the state of a scene before its last refresh."""

    def run(self) -> int:
        if (self.undo is None) == (not self.images):
            raise InputError("give images of the changed room, or --undo SCENE")
        from evercal.map import Map
        from evercal.recordings.image_files import image_files
        from evercal.storage import read_manifest

        read_manifest(self.store)
        cell = Map.open(self.store)
        if self.undo is not None:
            cell.undo_refresh(self.undo)
            line = f"{self.undo}: the state before its last refresh is back"
            self.answer({"scene": self.undo, "undone": True}, line)
            return 0
        with Bars(self.log) as bars:
            images = _recording(self.images)
            camera = None
            if not images:
                images = image_files(self.images)
                camera = args.camera_for(self.camera, images)
            elif images.train:
                shape = images.train[0].camera.size
                camera = args.stated_camera(self.camera, shape)
            report = cell.refresh(images, camera=camera, on_progress=bars.step)
        then = ("refresh", self.store, "--undo", report.scene)
        self.answer(dataclasses.asdict(report), *_lines(report), then=then)
        return 0


def _recording(paths: tuple[Path, ...]) -> "Recording | None":
    """The recording at a single path; None for images."""
    from evercal.recordings.load import load_recording, recognised

    if len(paths) != 1 or paths[0].is_file() or recognised(paths[0]) is None:
        return None
    return load_recording(paths[0])


def _lines(report: "RefreshReport") -> Iterator[str]:
    checked = report.landmarks_checked
    gone = report.landmarks_gone
    located = f"{report.located} of {report.images} images located"
    yield f"{report.scene}: {located}, refreshed in {report.seconds:.1f} s"
    share = f"{100 * gone / max(checked, 1):.0f} %"
    yield f"  landmarks    {gone:,} of {checked:,} in view are gone ({share})"
    keyframes = f"{report.keyframes_left} replaced, {report.keyframes_added} new"
    yield f"  keyframes    {keyframes}; {size(report.memory_bytes)}"
    shift = motion(report.shift_mm, report.shift_deg)
    sigma = motion(report.shift_sigma_mm, report.shift_sigma_deg)
    outside = f"{report.verified} images outside the map"
    yield f"  base frame   moved by {shift} (standard deviation {sigma}; {outside})"
    for name, reason in list(report.left_out.items())[:_LISTED]:
        yield f"  left out     {name}: {reason}"
    more = len(report.left_out) - _LISTED
    if more > 0:
        yield f"  left out     and {more} more images"
