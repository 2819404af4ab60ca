"""The HTTP service as a deployment of Ray Serve: replicas on the machines of a cluster."""

import logging
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2

from evercal.cluster import connected
from evercal.errors import InputError
from evercal.map import Map
from evercal.processes import cores
from evercal.service.client import Client
from evercal.service.hosts import url_of
from evercal.service.server import DRAIN_S, ServeOptions, make_app, require_token
from evercal.typing import Strings

if TYPE_CHECKING:
    from fastapi import FastAPI

NAME = "evercal"
"""Of the application in the cluster."""


def deployment(options: ServeOptions, replicas: int) -> Any:
    """The service as an application of Ray Serve; every replica has one core and opens the map.

    The token and the limits are those of `evercal serve`, except for what only the server of a
    connection can bound: the proxies of the cluster accept connections.
    """
    from ray import serve

    def build() -> "FastAPI":
        cv2.setNumThreads(cores())  # those of the replica, not of its machine
        return make_app(options)

    limits = options.limits
    how = serve.deployment(
        name="map",
        num_replicas=replicas,
        ray_actor_options={"num_cpus": 1},
        max_ongoing_requests=limits.requests + limits.streams,
        max_queued_requests=limits.connections,
        graceful_shutdown_timeout_s=DRAIN_S,
        logging_config={"enable_access_log": False, "log_level": "ERROR"},
    )
    return how(serve.ingress(build)()).bind()


def serve_on_ray(
    options: ServeOptions,
    address: str,
    replicas: int,
    on_ready: Callable[[str, Strings], object],
) -> None:
    """Serve a map on a cluster until SIGTERM or SIGINT; see `server.serve`.

    If Serve was started here and has no other application, it ends as well.

    Args:
        options: Its `host` and `port` are those of the cluster's head.
        address: Of the cluster, see `cluster.connected`.
        replicas: Processes that answer; all their machines reach the map.
        on_ready: Gets the address and the names of the scenes.
    """
    if options.token is None:
        raise InputError(
            "`ray`: other machines could use the map; give `token_file`, or set EVERCAL_TOKEN"
        )
    require_token(options.token)
    if not 1 <= options.port <= 65_535:
        raise InputError(f"`port` {options.port}: give 1 to 65535")
    if replicas < 1:
        raise InputError(f"`replicas` {replicas}: give a number >= 1")
    options = replace(options, map=options.map.absolute())
    scenes = Map.open(options.map).scenes
    options = replace(options, known=bool(scenes))
    stop = threading.Event()
    with connected(address) as ray:
        from ray import serve

        logging.getLogger("ray.serve").setLevel(logging.ERROR)
        ours = not serve.status().proxies
        serve.start(
            http_options={"host": options.host, "port": options.port},
            logging_config={"log_level": "ERROR"},
        )
        if NAME in serve.status().applications:
            raise InputError(f"`ray` {address}: serves a map already; stop that first")
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: stop.set())
        try:
            serve.run(deployment(options, replicas), name=NAME)
            url = url_of(_listening_host(ray, options.host), options.port)
            # It fails where a Serve that ran before listens elsewhere.
            if Client(url, options.token).scenes != scenes:
                raise InputError(
                    f"{options.map}: machines of the cluster do not reach this folder"
                )
            on_ready(url, scenes)
            while not stop.wait(1.0):  # without end, Ctrl-C does not end it on Windows
                pass
        except RuntimeError as error:
            raise InputError(f"`ray` {address}: {error}") from None
        finally:
            serve.delete(NAME)
            if ours and not serve.status().applications:
                serve.shutdown()


def _listening_host(ray: Any, host: str) -> str:
    """Address of the cluster's head where it listens on all of its addresses."""
    if host in ("0.0.0.0", "::"):
        for node in ray.nodes():
            if "node:__internal_head__" in node["Resources"]:
                return node["NodeManagerAddress"]
    return host
