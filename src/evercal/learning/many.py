"""Many recordings at once: every scene is independent, so each is learned in a process of its own.

The processes are those of this machine, or workers of a Ray cluster (`learning.on_ray`). One that
is killed, for example for its memory, costs its recording another try, alone.
"""

import itertools
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from evercal.errors import InputError
from evercal.learning.on_ray import done_on_ray
from evercal.learning.task import Item, Learned, LearnTask, Source, Task
from evercal.processes import Worker, cause_of, cores, first_answers
from evercal.progress import OnProgress
from evercal.recordings.addresses import RecordingAt, is_address
from evercal.recordings.frame import Recording, checked_name
from evercal.recordings.held_out import named_recording
from evercal.typing import PathLike

TRIES = 3
"""Attempts before a recording whose process is killed is given up."""


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
        yield task.done(*waiting.pop(0))
    yield from each_done(task, waiting, min(workers, max(1, len(waiting))), ray)


def each_done(
    task: Task,
    items: Iterable[Item],
    workers: int,
    ray: str | None = None,
) -> Iterator[Any]:
    """Do numbered work in worker processes, and yield outcomes as they are ready.

    Items are taken when a worker is free for them.
    """
    if ray is not None:
        return (yield from done_on_ray(task, items, ray))
    ended = yield from _in_turn(task, items, workers)
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
            yield task.failed(*item, cause_of(status, tries))


def _in_turn(
    task: Task, items: Iterable[Item], workers: int
) -> Generator[Any, None, list[tuple[Item, int]]]:
    """Do work; return the items whose process ended, each with its exit status."""
    waiting = iter(items)
    ended = list[tuple[Item, int]]()
    threads = max(1, cores() // workers)
    state = (task, threads)
    idle = list[Worker]()
    busy = dict[Worker, Item]()
    try:
        while True:
            for item in itertools.islice(waiting, workers - len(busy)):
                worker = (
                    idle.pop() if idle else Worker(_begin, state, _few_threads(threads))
                )
                worker.ask(item)
                busy[worker] = item
            if not busy:
                break
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


def _begin(state: tuple[Any, int]) -> Callable[[Item], Any]:
    import cv2

    task, threads = state
    cv2.setNumThreads(threads)
    return lambda item: task.done(*item)


def named_sources(
    recordings: Iterable[PathLike | Recording],
    read: Callable[[Path], Recording],
    taken: Iterable[str],
    absolute: bool,
) -> tuple[list[Source], list[str]]:
    """Recordings under the names of their scenes, and why the others cannot be used.

    A name that is `taken`, or that two recordings have, is refused. Paths become `absolute` where
    workers begin in another folder.
    """
    taken = {*taken}
    sources: list[Source] = []
    failed: list[str] = []
    for item in recordings:
        try:
            if isinstance(item, Recording):
                source = item
            elif is_address(item):
                source = RecordingAt.of(str(item))
            elif absolute:
                source = read(Path(os.path.abspath(item)))
            else:
                source = read(Path(item))
            checked_name(source.name)
        except InputError as error:
            failed.append(str(error))
            continue
        sources.append(named_recording(source, None, taken))
        taken.add(source.name)
    return sources, failed


def results_at(results: PathLike | None) -> str | None:
    """Address of the folder of results; a path becomes absolute."""
    if results is None:
        return None
    if is_address(results):
        return os.fspath(results)
    return os.path.abspath(results)


def in_given_order(
    outcomes: Iterable[Learned], total: int, on_progress: OnProgress
) -> Iterator[Learned]:
    """Outcomes in the order of their recordings, each as soon as those before it are known."""
    on_progress("learning", 0, total)
    ready: dict[int, Learned] = {}
    following = 0
    for done, outcome in enumerate(outcomes, 1):
        on_progress("learning", done, total)
        ready[outcome.number] = outcome
        while following in ready:
            yield ready.pop(following)
            following += 1


def refuse_failures(failed: Sequence[str], total: int) -> None:
    """Refuse recordings that were not learned, after the others were."""
    if failed:
        raise InputError(
            f"{len(failed)} of {total} recordings were not learned: {'; '.join(failed)}"
        )
