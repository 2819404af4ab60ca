"""A connection to a Ray cluster (Moritz et al., OSDI 2018), which others have started."""

import logging
import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from evercal.bounds import VARIABLE
from evercal.errors import InputError, optional_module

WAIT_S = 10.0
"""Time for a cluster to accept a connection, seconds."""
_INHERITED = (VARIABLE, "OPENCV_IO_MAX_IMAGE_PIXELS")
"""Variables that bound what is read; workers get them, too."""


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """The module `ray`, connected to a cluster; an existing connection is used and kept."""
    ray = optional_module("ray", "a cluster needs Ray", "ray")
    if ray.is_initialized():
        yield ray
        return
    _require_listener(address)
    inherited = {name: os.environ[name] for name in _INHERITED if name in os.environ}
    # Workers import from the folder that the program was started in, where a recording may lie that
    # holds any file; with a folder of their own they do not.
    with tempfile.TemporaryDirectory(prefix="evercal-") as empty:
        environment = {"env_vars": inherited, "working_dir": empty}
        try:
            ray.init(
                address,
                runtime_env=environment,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        except (ConnectionError, TimeoutError, ValueError, RuntimeError) as error:
            reason = str(error).strip().partition("\n")[0]
            raise InputError(
                f"`ray` {address}: {reason[:300]}; start a cluster, or give HOST:PORT of one"
            ) from None
    # Ray prints messages of its machines to stdout, whatever `log_to_driver` is; JSON is there.
    ray._private.worker._worker_logs_enabled = False
    try:
        yield ray
    finally:
        ray.shutdown()


def _require_listener(address: str) -> None:
    """Refuse an address where nothing listens; Ray would wait for minutes."""
    if address in ("auto", "local"):
        return
    _, _, host_port = address.rpartition("://")
    url = urlsplit(f"//{host_port}")
    try:
        socket.create_connection((url.hostname or "", url.port or 0), WAIT_S).close()
    except (OSError, ValueError) as error:
        raise InputError(
            f"`ray` {address}: nothing answers ({error}); give auto, or HOST:PORT or"
            " ray://HOST:PORT of a cluster"
        ) from None
