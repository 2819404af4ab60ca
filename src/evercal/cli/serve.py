"""`evercal serve`."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json
from evercal.cli.options import Device
from evercal.errors import missing_extra

TOKEN = "EVERCAL_TOKEN"


@dataclass(frozen=True)
class Serve:
    """Serve a map over HTTP: localize, calibrate, check, track; see /docs of the service.

    It answers this machine only, unless --host names another address, which requires a token.
    Scenes that `evercal learn` adds meanwhile are noticed. SIGTERM or Ctrl-C stops it after the
    requests under way.

    Example: evercal serve cell.evercal --port 8000
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the map; it may be missing until a first scene is learned."""
    port: Annotated[int, arg(metavar="P")] = 8000
    """Port to listen on; 0 for any free one."""
    host: Annotated[str, arg(metavar="H")] = "127.0.0.1"
    """Address to listen on, such as 0.0.0.0 for all of this machine's."""
    token: Annotated[str | None, arg(metavar="T", help_behavior_hint="")] = None
    """Requests must have it as bearer token. Default: the variable EVERCAL_TOKEN, which other users
    of the machine cannot read."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object when it accepts requests."""

    def run(self) -> int:
        """Serve until SIGTERM or Ctrl-C."""
        try:
            from evercal.service.server import ServeOptions, serve
        except ImportError as error:
            raise missing_extra(f"the service needs {error.name}", "serve") from None

        token = self.token or os.environ.get(TOKEN) or None
        serve(
            ServeOptions(self.store, self.host, self.port, token, self.device),
            self._ready,
        )
        return 0

    def _ready(self, url: str, scenes: tuple[str, ...]) -> None:
        if self.json:
            print_json({"url": url, "store": str(self.store), "scenes": list(scenes)})
            return
        what = ", ".join(scenes) or "no scene yet"
        print(f"serving {self.store} ({what}) at {url}; its page is {url}/docs", flush=True)
