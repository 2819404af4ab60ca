"""Recordings learned by the workers of a Ray cluster (Moritz et al., OSDI 2018)."""

import logging
import os
import socket
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import evercal
from evercal.bounds import VARIABLE
from evercal.errors import InputError, optional_module
from evercal.learning.many import Item, Learned, LearnTask

TRIES = 20
"""Attempts for a recording: machines of a cluster come and go, and a task that runs out of memory
is tried again without being counted."""
WAIT_S = 10.0
"""Time for a cluster to accept a connection."""
AHEAD = 4
"""Recordings that wait for each core, so that an autoscaler has a reason to add machines."""


def learn_on_ray(task: LearnTask, items: Sequence[Item], address: str) -> Iterator[Learned]:
    """Learn recordings on a cluster, and yield outcomes as they are ready.

    Args:
        task: Encoder and options.
        items: Recordings or addresses, each with its number. All machines reach their files.
        address: `auto`, `HOST:PORT`, `ray://HOST:PORT`, or `local` for a cluster of this machine.
    """
    with connected(address) as ray:
        learn = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_learned)
        shared, waiting, running = ray.put(task), [*items][::-1], dict[Any, Item]()
        try:
            while waiting or running:
                most = AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
                while waiting and len(running) < most:
                    item = waiting.pop()
                    running[learn.remote(shared, evercal.__version__, *item)] = item
                for done in ray.wait([*running], num_returns=1)[0]:
                    number = running.pop(done)[0]
                    try:
                        outcome = ray.get(done)
                    except ray.exceptions.RayError as error:
                        cause = str(error).strip().splitlines()[-1:]
                        outcome = Learned(number, error=f"on Ray: {''.join(cause)}")
                    yield outcome
        finally:  # also when the caller stops iterating
            for reference in running:
                ray.cancel(reference, force=True)


def _learned(task: LearnTask, version: str, number: int, source: Any) -> Learned:
    import cv2

    cv2.setNumThreads(1)
    if version != evercal.__version__:
        here = f"the worker has evercal {evercal.__version__}, this program {version}"
        return Learned(number, error=f"{here}; install the same on all machines")
    return task.learn(number, source)


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """The module `ray`, connected to a cluster; an existing connection is used and kept."""
    ray = optional_module("ray", "learning on a cluster needs Ray", "ray")
    if TYPE_CHECKING:
        import ray
    if ray.is_initialized():
        yield ray
        return
    _require_listener(address)
    given = {name: os.environ[name] for name in _INHERITED if name in os.environ}
    # Workers import from the folder that the program was started in, where a recording may lie that
    # holds any file; with a folder of their own they do not.
    with tempfile.TemporaryDirectory(prefix="evercal-") as empty:
        environment = {"env_vars": given, "working_dir": empty}
        try:
            ray.init(
                address, runtime_env=environment, log_to_driver=False, logging_level=logging.ERROR
            )
        except (ConnectionError, TimeoutError, ValueError, RuntimeError) as error:
            reason = str(error).strip().partition("\n")[0]
            raise InputError(
                f"--ray {address}: {reason[:300]}; start a cluster with 'ray start --head', or"
                " give HOST:PORT of one"
            ) from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _require_listener(address: str) -> None:
    """Refuse an address where nothing listens; Ray would wait for minutes."""
    url = urlsplit(address if "://" in address else f"//{address}")
    if address not in ("auto", "local"):
        try:
            socket.create_connection((url.hostname or "", url.port or 0), WAIT_S).close()
        except (OSError, ValueError) as error:
            raise InputError(
                f"--ray {address}: nothing answers ({error}); give auto, or HOST:PORT or"
                " ray://HOST:PORT of a cluster"
            ) from None


_INHERITED = (VARIABLE, "OPENCV_IO_MAX_IMAGE_PIXELS")
