"""`evercal serve`."""

import os
from dataclasses import dataclass

from evercal.cli.options import Device, Host, Name, Port, Store, Verb
from evercal.errors import missing_extra

TOKEN = "EVERCAL_TOKEN"


@dataclass(frozen=True)
class Serve(Verb):
    """Serve a map over HTTP: localize, calibrate, check, track; see /docs of the service.

    It answers this machine only, unless --host names another address, which requires a token. The
    map may be missing until a first scene is learned; scenes that `evercal learn` adds meanwhile
    are noticed. SIGTERM or Ctrl-C stops it after the requests under way.

    Example: evercal serve cell.evercal --port 8000
    """

    store: Store
    port: Port = 8000
    host: Host = "127.0.0.1"
    token: Name = None
    """Requests must have it as bearer token. Default: the variable EVERCAL_TOKEN, which other users
    of the machine cannot read."""
    device: Device = "auto"

    def run(self) -> int:
        try:
            from evercal.service.server import ServeOptions, serve
        except ImportError as error:
            raise missing_extra(f"the service needs {error.name}", "serve") from None

        token = self.token or os.environ.get(TOKEN) or None
        serve(ServeOptions(self.store, self.host, self.port, token, self.device), self._ready)
        return 0

    def _ready(self, url: str, scenes: tuple[str, ...]) -> None:
        what = ", ".join(scenes) or "no scene yet"
        self.answer(
            {"url": url, "store": str(self.store), "scenes": list(scenes)},
            f"serving {self.store} ({what}) at {url}; its page is {url}/docs",
        )
