"""`evercal view`."""

import contextlib
import shlex
import signal
import socket
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.arguments import open_map
from evercal.cli.console import print_json
from evercal.cli.options import Device, File, Host, Port, Source, Store, Verb
from evercal.errors import InputError, missing_extra
from evercal.service.hosts import is_local


@dataclass(frozen=True)
class View(Verb):
    """Show a map in 3D in the browser, with calibrations, the arm, and a tracked camera.

    It is stopped by Ctrl-C or SIGTERM. The page has no password and is served on 127.0.0.1, unless
    --host names another address.

    Example: evercal view cell.evercal tripod.json --live 0
    """

    store: Store
    calibrations: Annotated[
        Positional[tuple[Path, ...]],
        arg(metavar="[CALIBRATION.json...]", help_behavior_hint="(default: none)"),
    ] = ()
    """Calibration files to draw."""
    live: Source = None
    """Camera to track: its number (0) or device, an address (rtsp://...), a video or a folder."""
    camera: File = None
    """Intrinsics of the live camera. Default: those of the camera that recorded the scene."""
    urdf: File = None
    """Robot description of the arm; its base link is at the robot base."""
    host: Host = "127.0.0.1"
    port: Port = 8080
    device: Device = "auto"

    def run(self) -> int:
        if self.camera is not None and self.live is None:
            raise InputError("--camera: is that of --live, which is missing")
        prepare_page(self.host, "sees the map and the images")
        from evercal.service.viewer.page import Page

        address = (self.host, self.port)
        page = Page(open_map(self.store, self.device), self.calibrations, self.urdf, address)
        try:
            if self.live is not None:
                page.track(self.live, self.camera)
            port = page.server.url.rpartition(":")[2]
            tunnel = shlex.join(["ssh", "-L", f"{port}:127.0.0.1:{port}", socket.gethostname()])
            words = f"view of {self.store} at {page.server.url} (from another machine: {tunnel})"
            wait_until_stopped(page.server.url, None if self.json else words)
        finally:
            page.close()
        return 0


def prepare_page(host: str, danger: str) -> None:
    """Require the extra `view`, and warn if other machines can open the page."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise missing_extra(f"the page needs {error.name}", "view") from None
    if not is_local(host):
        who = "the page has no password; whoever reaches this machine"
        print(f"warning: --host {host}: {who} {danger}", file=sys.stderr)


def wait_until_stopped(url: str, words: str | None) -> None:
    """Print words, or the address as JSON, and wait for SIGTERM or Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        if words is None:
            print_json({"url": url})
        else:
            print(f"{words}; Ctrl-C ends it", flush=True)
        threading.Event().wait()
