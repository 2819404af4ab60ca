"""Many recordings at once: every scene is independent, so each is learned in a process of its own.

A process that is killed, for example for its memory, costs its recording another try, alone.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass

from evercal.errors import InputError
from evercal.learning.scene import LearnReport, learn_scene
from evercal.mapping.build import MapOptions
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.processes import Worker, cause_of, cores, first_answers
from evercal.recordings.frame import Recording

TRIES = 3
"""Attempts before a recording whose process is killed is given up."""


@dataclass(frozen=True, eq=False)
class Learned:
    """Outcome of one of many recordings."""

    number: int
    """Place of the recording among those given."""
    scene: SceneMap | None = None
    """None if it failed."""
    report: LearnReport | None = None
    error: str = ""
    """Cause, in one line, if it failed."""


@dataclass(frozen=True, eq=False)
class LearnTask:
    """What is the same for all recordings."""

    contents: MapContents
    """Encoder and image size; without scenes."""
    memory: str | int | None = None
    """Keyframes to keep, as for `Map.learn`."""
    options: MapOptions | None = None
    """Sizes and priors of the map."""

    def learn(self, number: int, recording: Recording) -> Learned:
        """Learn one recording; an unusable one becomes an outcome."""
        try:
            scene, report = learn_scene(recording, self.contents, self.memory, options=self.options)
        except InputError as error:
            return Learned(number, error=str(error))
        return Learned(number, scene, report)


Item = tuple[int, Recording]
_State = tuple[LearnTask, int]
"""Task and threads of a worker."""


def learn_scenes(
    task: LearnTask, recordings: Sequence[Recording], workers: int
) -> Iterator[Learned]:
    """Learn recordings in worker processes, and yield outcomes as they are ready.

    The threads of this machine are divided among the workers.

    Args:
        task: Encoder and options.
        recordings: Recordings; images in memory are copied to the workers.
        workers: Processes, >= 1.
    """
    if workers < 1:
        raise InputError(f"workers {workers}: give a number >= 1")
    waiting = list(enumerate(recordings))
    # All scenes share the centroids, which the first recording of another encoder determines.
    while waiting and task.contents.encoder.centroids is None:
        yield task.learn(*waiting.pop(0))
    ended = yield from _in_turn(task, waiting, workers)
    for item, status in ended:
        tries = 1
        while status < 0 and tries < TRIES:  # alone, so that others do not share its memory
            again = yield from _in_turn(task, [item], 1)
            if not again:
                break
            status, tries = again[0][1], tries + 1
        else:
            yield Learned(item[0], error=cause_of(status, tries))


def _in_turn(
    task: LearnTask, items: Sequence[Item], workers: int
) -> Generator[Learned, None, list[tuple[Item, int]]]:
    """Learn items; return those whose process ended, each with its exit status."""
    waiting, ended = list(items), list[tuple[Item, int]]()
    workers = min(workers, len(waiting))
    threads = max(1, cores() // max(workers, 1))
    state: _State = (task, threads)
    idle, busy = list[Worker](), dict[Worker, Item]()
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                worker = idle.pop() if idle else Worker(_begin, state, _few_threads(threads))
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
