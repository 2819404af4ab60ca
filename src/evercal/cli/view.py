"""`evercal view`."""

import shlex
import signal
import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json
from evercal.cli.options import Device
from evercal.cli.stores import open_map
from evercal.errors import InputError
from evercal.service.hosts import is_local


@dataclass(frozen=True)
class View:
    """Show a map in 3D in the browser, with calibrations, the arm, and a tracked camera.

    It is stopped by Ctrl-C or SIGTERM. The page has no password and is served on 127.0.0.1, unless
    --host names another address.

    Example: evercal view cell.evercal tripod.json --recording samples/cell/wrist
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the map."""
    calibrations: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="[CALIBRATION.json...]", help_behavior_hint="(default: none)"),
    ] = ()
    """Calibration files to draw."""
    live: Annotated[str | None, arg(metavar="SOURCE", help_behavior_hint="")] = None
    """Camera to track: its number (0) or device, an address (rtsp://...), a video or a folder."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Intrinsics of the live camera. Default: those of the camera that recorded the scene."""
    urdf: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Robot description of the arm; its base link is at the robot base."""
    recording: Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")] = None
    """Recording whose frames are located, one after another."""
    host: Annotated[str, arg(metavar="H")] = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, arg(metavar="P")] = 8080
    """Port to listen on; 0 for any free one."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object when the page is ready."""

    def run(self) -> int:
        """Serve the page until Ctrl-C or SIGTERM."""
        if self.camera is not None and self.live is None:
            raise InputError("--camera: is that of --live, which is missing")
        try:
            from evercal.service.viewer.page import Page, ViewOptions
        except ImportError as error:
            raise InputError(
                f"the view needs {error.name}; run: pip install 'evercal[view]'"
            ) from None
        if not is_local(self.host):
            print(
                f"warning: --host {self.host}: the page has no password; whoever reaches this"
                " machine sees the map and the images",
                file=sys.stderr,
            )
        options = ViewOptions(
            calibrations=self.calibrations,
            live=self.live,
            camera=self.camera,
            urdf=self.urdf,
            recording=self.recording,
            host=self.host,
            port=self.port,
        )
        try:
            page = Page(open_map(self.store, self.device), options)
            try:
                until_stopped(lambda: self._ready(page.url))
            finally:
                page.close()
        except KeyboardInterrupt:
            pass
        return 0

    def _ready(self, url: str) -> None:
        if self.json:
            print_json({"url": url})
            return
        port = url.rpartition(":")[2]
        tunnel = shlex.join(["ssh", "-L", f"{port}:127.0.0.1:{port}", socket.gethostname()])
        print(f"view of {self.store} at {url} (from another machine: {tunnel}); Ctrl-C ends it")
        sys.stdout.flush()


def until_stopped(ready: Callable[[], object]) -> None:
    """Call `ready` and return at SIGTERM or Ctrl-C."""
    stopped = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()

    ends = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, stop) for number in ends]
    try:
        ready()
        stopped.wait()
    finally:
        for number, handler in zip(ends, before, strict=True):
            signal.signal(number, handler)
