"""`evercal serve`."""

import os

from evercal.classes import frozen
from evercal.cli import args
from evercal.errors import InputError, missing_extra

TOKEN = "EVERCAL_TOKEN"
"""Environment variable of the bearer token."""


@frozen
class Serve(args.Verb):
    """Serve a map over HTTP: localize, calibrate, check, track; see /docs of the service.

    It answers this machine only, unless --host names another address, which requires a token. The
    map may be missing until a first scene is learned; scenes that `evercal learn` adds meanwhile
    are noticed. SIGTERM or Ctrl-C stops it after the requests under way.

    Example: evercal serve cell.evercal --port 8000
    """

    store: args.Store
    port: args.Port = 8000
    host: args.Host = "127.0.0.1"
    token_file: args.File = None
    """File of the bearer token that requests must have, readable by you alone. Default: the
    variable EVERCAL_TOKEN."""
    ray: args.Address = None
    """Serve from a Ray cluster (auto, HOST:PORT or ray://HOST:PORT); its head listens."""
    replicas: args.Number = 1
    """Processes that answer in the cluster, each with one core."""

    def run(self) -> int:
        try:
            from evercal.service.on_ray import serve_on_ray
            from evercal.service.server import ServeOptions, serve
        except ImportError as error:
            raise missing_extra(f"the service needs {error.name}", "serve") from None

        token = os.environ.pop(TOKEN, None) or None  # other processes do not inherit it
        if self.token_file:
            try:
                token = self.token_file.read_text(encoding="utf-8").strip()
            except (OSError, ValueError) as error:
                raise InputError(f"--token-file {self.token_file}: {error}") from None
        options = ServeOptions(self.store, self.host, self.port, token)
        if self.ray is not None:
            serve_on_ray(options, self.ray, self.replicas, self._ready)
        elif self.replicas != 1:
            raise InputError(f"--replicas {self.replicas}: give --ray, too")
        else:
            serve(options, self._ready)
        return 0

    def _ready(self, url: str, scenes: tuple[str, ...]) -> None:
        what = ", ".join(scenes) or "no scene yet"
        self.answer(
            {"url": url, "store": str(self.store), "scenes": list(scenes)},
            f"serving {self.store} ({what}), with a page of its requests:",
            f"  {url}",
        )
