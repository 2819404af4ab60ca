"""Many recordings at once: every scene is independent, so each is learned in a process of its own.

A process that is killed, for example for its memory, costs its recordings another try, alone.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event

import torch

from evercal.errors import InputError
from evercal.features.vlad import keep_centroids, known_centroids, lacks_centroids
from evercal.learning.scene import LearnReport, learn_scene
from evercal.mapping.build import MapOptions
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.recordings.frame import Recording

TRIES = 3
"""Attempts before a recording whose process is killed is given up."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
    while waiting and lacks_centroids(task.contents.encoder):
        yield task.learn(*waiting.pop(0))
    while waiting:
        killed, waiting = yield from _attempt(task, waiting, workers)
        for item in killed:
            # Alone, so that it neither takes others with it nor shares their memory.
            for _ in range(TRIES - 1):
                again, _none = yield from _attempt(task, [item], 1)
                if not again:
                    break
            else:
                error = f"its process was killed {TRIES} times; is there enough memory?"
                yield Learned(item[0], error=error)


def _attempt(
    task: LearnTask, items: Sequence[Item], workers: int
) -> Generator[Learned, None, tuple[list[Item], list[Item]]]:
    """Learn items until a worker is killed; return those that were under way, and the rest."""
    waiting, running = list(items), dict[Future[Learned], Item]()
    stop = multiprocessing.get_context("spawn").Event()
    with _pool(task, min(workers, len(items)), stop) as pool:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    try:
                        future = pool.submit(_learn, *waiting[0])
                    except BrokenProcessPool:  # killed while the caller used a result
                        return list(running.values()), waiting
                    running[future] = waiting.pop(0)
                ready, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in ready:
                    if not isinstance(future.exception(), BrokenProcessPool):
                        yield future.result()
                        del running[future]
                if any(future in running for future in ready):
                    break
        except BaseException:  # also when the caller stops iterating
            stop.set()
            raise
    return list(running.values()), waiting


@contextmanager
def _pool(task: LearnTask, workers: int, stop: Event) -> Iterator[ProcessPoolExecutor]:
    """A pool whose workers share the threads of this machine."""
    threads = max(1, torch.get_num_threads() // workers)
    before = {name: os.environ.get(name) for name in _THREADS}
    # Read when a process loads its libraries; inherited from this one.
    os.environ.update(dict.fromkeys(_THREADS, str(threads)))
    try:
        with ProcessPoolExecutor(
            workers,
            multiprocessing.get_context("spawn"),  # threads of torch do not survive a fork
            _begin,
            (task, threads, stop, known_centroids(task.contents.encoder)),
        ) as pool:
            yield pool
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_task: LearnTask | None = None
"""In a worker process: its task."""


def _begin(task: LearnTask, threads: int, stop: Event, centroids: torch.Tensor | None) -> None:
    import cv2

    global _task
    _task = task
    if centroids is not None:  # they do not travel with the encoder
        keep_centroids(task.contents.encoder, centroids)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its parent ends it
    end_with_parent(stop)


def end_with_parent(stop: Event | None = None) -> None:
    """End this process when its parent is gone, or when `stop` is set; returns at once.

    For processes that work for another one, which may be killed.
    """
    parent, ended = multiprocessing.parent_process(), stop or threading.Event()
    assert parent is not None, "called in a process that multiprocessing started"

    def watch() -> None:
        while not ended.wait(1.0) and parent.is_alive():
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _learn(number: int, recording: Recording) -> Learned:
    assert _task is not None, "set by _begin"
    return _task.learn(number, recording)
