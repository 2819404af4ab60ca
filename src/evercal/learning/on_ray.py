"""Work that is done by the workers of a Ray cluster, such as recordings to learn."""

import itertools
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from typing import Any

from evercal.cluster import connected
from evercal.learning.task import Item, Task

TRIES = 20
"""Attempts for a recording: machines of a cluster come and go."""
AHEAD = 4
"""Recordings that wait for each core, so that an autoscaler has a reason to add machines."""


def done_on_ray(task: Task, items: Iterable[Item], address: str) -> Iterator[Any]:
    """Do numbered work on a cluster, and yield outcomes as they are ready.

    Args:
        task: What is done.
        items: Such as recordings or addresses, each with its number. All machines reach their
            files.
        address: `auto`, `HOST:PORT`, `ray://HOST:PORT`, or `local` for a cluster of this machine.
    """
    with connected(address) as ray:
        learn = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_learned)
        shared = ray.put(task)
        waiting = iter(items)
        running = dict[Any, Item]()
        try:
            while True:
                most = AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
                for item in itertools.islice(waiting, max(0, most - len(running))):
                    running[learn.remote(shared, version("evercal"), *item)] = item
                if not running:
                    break
                for done in ray.wait([*running], num_returns=1)[0]:
                    item = running.pop(done)
                    try:
                        outcome = ray.get(done)
                    except ray.exceptions.RayError as error:
                        cause = str(error).strip().splitlines()[-1:]
                        outcome = task.failed(*item, f"on Ray: {''.join(cause)}")
                    yield outcome
        finally:  # also when the caller stops iterating
            for reference in running:
                ray.cancel(reference, force=True)


def _learned(task: Task, wanted: str, number: int, source: Any) -> Any:
    import cv2

    cv2.setNumThreads(1)
    if (here := version("evercal")) != wanted:
        error = (
            f"the worker has evercal {here}, this program {wanted}; install the same"
        )
        return task.failed(number, source, f"{error} on all machines")
    return task.done(number, source)
