"""Recordings learned by the workers of a Ray cluster."""

from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any

from evercal.cluster import connected
from evercal.learning.task import Item, Learned, LearnTask

TRIES = 20
"""Attempts for a recording: machines of a cluster come and go."""
AHEAD = 4
"""Recordings that wait for each core, so that an autoscaler has a reason to add machines."""


def learn_on_ray(
    task: LearnTask, items: Sequence[Item], address: str
) -> Iterator[Learned]:
    """Learn recordings on a cluster, and yield outcomes as they are ready.

    Args:
        task: Encoder and options.
        items: Recordings or addresses, each with its number. All machines reach their files.
        address: `auto`, `HOST:PORT`, `ray://HOST:PORT`, or `local` for a cluster of this machine.
    """
    with connected(address) as ray:
        learn = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_learned)
        shared = ray.put(task)
        waiting = [*items][::-1]
        running = dict[Any, Item]()
        try:
            while waiting or running:
                most = AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
                while waiting and len(running) < most:
                    item = waiting.pop()
                    running[learn.remote(shared, version("evercal"), *item)] = item
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


def _learned(task: LearnTask, wanted: str, number: int, source: Any) -> Learned:
    import cv2

    cv2.setNumThreads(1)
    if (here := version("evercal")) != wanted:
        error = (
            f"the worker has evercal {here}, this program {wanted}; install the same"
        )
        return Learned(number, error=f"{error} on all machines")
    return task.learn(number, source)
