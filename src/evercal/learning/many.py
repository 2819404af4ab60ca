"""Many recordings at once: every scene is independent, so each is learned in a process of its own.

The processes are those of this machine, or workers of a Ray cluster (`learning.on_ray`). One that
is killed, for example for its memory, costs its recording another try, alone.
"""

import hashlib
import pickle
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.learning.scene import LearnReport, learn_scene
from evercal.mapping.build import MapOptions
from evercal.mapping.manage import pack_map, unpack_map
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore
from evercal.processes import Worker, cause_of, cores, first_answers
from evercal.recordings import addresses, load_recording
from evercal.recordings.addresses import RecordingAt
from evercal.recordings.frame import Recording
from evercal.recordings.held_out import named_recording

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


Source = Recording | RecordingAt


@dataclass(frozen=True, eq=False)
class LearnTask:
    """What is the same for all recordings."""

    contents: MapContents
    """Encoder and image size; without scenes."""
    memory: str | int | None = None
    """Keyframes to keep, as for `Map.learn`."""
    options: MapOptions | None = None
    """Sizes and priors of the map."""
    read: Callable[[Path], Recording] = load_recording
    """Reads the copy of a recording at an address; it can be pickled."""
    results: str | None = None
    """Folder or address where learned scenes are kept: what lies there is not learned again."""

    def learn(self, number: int, source: Source) -> Learned:
        """Learn one recording; an unusable one becomes an outcome."""
        try:
            file = self._file(source)
            if file is None or not addresses.exists(file):
                learned = self._learn(source)
                if file is not None:
                    _keep(file, self.contents, *learned)
            else:
                learned = _kept(file)
        except InputError as error:
            return Learned(number, error=str(error))
        return Learned(number, *learned)

    def _learn(self, source: Source) -> tuple[SceneMap, LearnReport]:
        if isinstance(source, Recording):
            return learn_scene(source, self.contents, self.memory, options=self.options)
        with addresses.local_copy(source.address) as copy:
            return self._learn(named_recording(self.read(copy), source.name, ()))

    def _file(self, source: Source) -> str | None:
        """Address of the result: another recording, option or version gets another one."""
        if self.results is None:
            return None
        what = source if isinstance(source, Recording) else addresses.stamps(source.address)
        of = pickle.dumps((version("evercal"), self.contents, self.memory, self.options, what))
        return f"{self.results}/{source.name}-{hashlib.sha256(of).hexdigest()[:16]}.zip"


def _keep(file: str, contents: MapContents, scene: SceneMap, report: LearnReport) -> None:
    with tempfile.TemporaryDirectory(prefix="evercal-") as folder:
        root, packed = Path(folder, "map"), Path(folder, "map.zip")
        MapStore(root, contents.empty()).commit(scene, asdict(report))
        pack_map(root, packed)
        addresses.put(packed, file)


def _kept(file: str) -> tuple[SceneMap, LearnReport]:
    with addresses.local_copy(file) as packed, tempfile.TemporaryDirectory() as folder:
        unpack_map(packed, Path(folder, "map"))
        store = MapStore.open(Path(folder, "map"))
        scene, report = store.contents.scenes[0], LearnReport.from_dict(store.reports()[0])
        every = np.arange(len(scene.keyframes))  # taken out of the file, which goes
        return replace(scene, keyframes=scene.keyframes.take(every)), report


Item = tuple[int, Source]
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
        from evercal.learning.on_ray import learn_on_ray

        return (yield from learn_on_ray(task, waiting, ray))
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
