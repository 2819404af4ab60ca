"""`evercal view`."""

import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from evercal.classes import frozen
from evercal.cli import args
from evercal.errors import InputError, missing_extra


@dataclass(frozen=True, kw_only=True)
class PageVerb(args.Verb):
    """A verb that serves a page until Ctrl-C or SIGTERM."""

    host: args.Host = "127.0.0.1"
    port: args.Port = 8080

    def prepare(self) -> None:
        """Require the extra `view`."""
        try:
            import viser  # noqa: F401
        except ImportError as error:
            raise missing_extra(f"the page needs {error.name}", "view") from None


@frozen
class View(PageVerb):
    """Show a map, calibrations, arm and tracked camera in the browser.

    It is stopped by Ctrl-C or SIGTERM. The printed address holds the key of the page. It is served
    on 127.0.0.1, unless --host names another address.

    Example: evercal view cell.evercal tripod.json --live 0
    """

    store: args.Store
    calibrations: Annotated[
        Positional[tuple[Path, ...]],
        args.shown("[CALIBRATION.json...]", "(default: none)"),
    ] = ()
    """Calibration files to draw."""
    live: args.Source = None
    """Camera to track: its number (0) or device, an address (rtsp://...), a video or a folder."""
    camera: args.File = None
    """Intrinsics of the live camera. Default: those of the camera that recorded the scene."""
    urdf: args.File = None
    """Robot description of the arm; its base link is at the robot base."""

    def run(self) -> int:
        if self.camera and self.live is None:
            raise InputError("--camera: is that of --live, which is missing")
        self.prepare()
        from evercal.service.viewer.page import Page

        address = (self.host, self.port)
        page = Page(args.open_map(self.store), self.calibrations, self.urdf, address)
        try:
            if self.live is not None:
                page.track(self.live, self.camera)
            url = page.server.url
            port = page.server.get_port()
            tunnel = f"ssh -L {port}:127.0.0.1:{port} {socket.gethostname()}"
            words = f"view of {self.store} (from another machine: {tunnel})"
            self.wait({"url": url}, words, f"  {url}")
        finally:
            page.close()
        return 0
