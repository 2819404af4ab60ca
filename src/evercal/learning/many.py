"""Many recordings at once: every scene is independent, so each is learned in a process of its own.

The processes are those of this machine, or workers of a Ray cluster (`learning.on_ray`). One that
is killed, for example for its memory, costs its recording another try, alone.
"""

from collections.abc import Callable, Generator, Iterator, Sequence

from evercal.errors import InputError
from evercal.learning.on_ray import learn_on_ray
from evercal.learning.task import Item, Learned, LearnTask, Source
from evercal.processes import Worker, cause_of, cores, first_answers

TRIES = 3
"""Attempts before a recording whose process is killed is given up."""
_State = tuple[LearnTask, int]
"""Task and threads of a worker."""


def learn_scenes(
    task: LearnTask, sources: Sequence[Source], workers: int, ray: str | None = None
) -> Iterator[Learned]:
    """Learn recordings in worker processes, and yield outcomes as they are ready.

    The threads of this machine are divided among its workers.

    Args:
        task: Encoder and options.
        sources: Recordings, whose images in memory are copied to the workers; or addresses.
        workers: Processes of this machine, >= 1.
        ray: Address of a Ray cluster, whose workers learn instead.
    """
    if workers < 1:
        raise InputError(f"workers {workers}: give a number >= 1")
    waiting = list(enumerate(sources))
    # All scenes share the centroids, which the first recording of another encoder determines.
    while waiting and task.contents.encoder.centroids is None:
        yield task.learn(*waiting.pop(0))
    if ray is not None:
        return (yield from learn_on_ray(task, waiting, ray))
    ended = yield from _in_turn(task, waiting, workers)
    for item, status in ended:
        tries = 1
        # Alone, so that others do not share its memory.
        while status < 0 and tries < TRIES:
            again = yield from _in_turn(task, [item], 1)
            if not again:
                break
            status = again[0][1]
            tries = tries + 1
        else:
            yield Learned(item[0], error=cause_of(status, tries))


def _in_turn(
    task: LearnTask, items: Sequence[Item], workers: int
) -> Generator[Learned, None, list[tuple[Item, int]]]:
    """Learn items; return those whose process ended, each with its exit status."""
    waiting = list(items)
    ended = list[tuple[Item, int]]()
    workers = min(workers, len(waiting))
    threads = max(1, cores() // max(workers, 1))
    state: _State = (task, threads)
    idle = list[Worker]()
    busy = dict[Worker, Item]()
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                worker = (
                    idle.pop() if idle else Worker(_begin, state, _few_threads(threads))
                )
                if worker.ask(waiting[0]):
                    busy[worker] = waiting.pop(0)
                else:  # killed while it waited
                    worker.end()
            for worker in first_answers([*busy]):
                item = busy.pop(worker)
                try:
                    outcome = worker.answer()
                except EOFError:
                    ended.append((item, worker.end(patience_s=10.0)))
                else:
                    idle.append(worker)
                    yield outcome
    finally:  # also when the caller stops iterating
        for worker in (*idle, *busy):
            worker.end()
    return ended


def _few_threads(threads: int) -> dict[str, str]:
    """Variables that libraries read when a process loads them."""
    return dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads)
    )


def _begin(state: _State) -> Callable[[Item], Learned]:
    import cv2

    task, threads = state
    cv2.setNumThreads(threads)
    return lambda item: task.learn(*item)
