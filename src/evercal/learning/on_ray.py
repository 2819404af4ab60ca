"""Recordings learned by the workers of a Ray cluster."""

from collections.abc import Iterator, Sequence
from typing import Any

import evercal
from evercal.cluster import connected
from evercal.learning.many import Item, Learned, LearnTask

TRIES = 20
"""Attempts for a recording: machines of a cluster come and go, and a task that runs out of memory
is tried again without being counted."""
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
