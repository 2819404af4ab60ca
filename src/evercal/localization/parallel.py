"""Many images at once: one worker for each core, each with the calculations of one thread.

Threads that share one image's work wait for each other and share the short steps badly; an image
for each thread keeps every core busy. numpy and OpenCV let the interpreter go while they work, so
threads are enough. Every image is calculated as if it came alone.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from evercal.processes import cores

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_parallel(
    work: Callable[[Item], Result], items: Sequence[Item]
) -> Iterator[Result]:
    """Results of a function in the order of the items, from as many workers as there are cores.

    What `work` raises is raised when its turn comes; items not begun are left out.
    """
    workers = min(cores(), len(items))
    if workers < 2:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(workers, "image") as pool:
        yield from pool.map(work, items)
