"""Many images at once: one worker for each core, each with the calculations of one thread.

Threads that share one image's work wait for each other and share the short steps badly; an image
for each thread keeps every core busy. numpy, OpenCV and torch let the interpreter go while they
work, so threads are enough. Every image is calculated as if it came alone.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_parallel(work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Results of a function in the order of the items, from as many workers as torch has threads.

    What `work` raises is raised when its turn comes; items not begun are left out.
    """
    threads = torch.get_num_threads()
    workers = min(threads, len(items))
    if workers < 2:
        yield from map(work, items)
        return
    share = max(1, threads // workers)
    try:
        with ThreadPoolExecutor(workers, "image", torch.set_num_threads, (share,)) as pool:
            yield from pool.map(work, items)
    finally:
        # What a worker sets for itself is also what threads made later start with.
        torch.set_num_threads(threads)
