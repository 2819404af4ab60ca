"""One of many recordings: what is learned, by whichever process, and where the result is kept."""

import hashlib
import logging
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError, printable
from evercal.learning.report import LearnReport
from evercal.learning.scene import learn_scene
from evercal.mapping.build import MapOptions
from evercal.mapping.manage import pack_map, unpack_map
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import MapStore
from evercal.recordings import addresses, load_recording
from evercal.recordings.addresses import RecordingAt
from evercal.recordings.frame import Recording
from evercal.recordings.held_out import named_recording

_RESULT = "result"
"""Entry of a stored report: name of the file of results, which has the recording's digest."""


@frozen_arrays
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
Item = tuple[int, Any]
"""Such as a recording, with its place among those given."""


class Task(Protocol):
    """What is done in worker processes; it can be pickled."""

    def done(self, number: int, source: Any) -> Any:
        """Do one of many things, and return the outcome."""
        ...

    def failed(self, number: int, source: Any, error: str) -> Any:
        """The outcome for one whose process ended."""
        ...


@frozen_arrays
class LearnTask:
    """What is the same for all recordings."""

    contents: MapContents
    """Encoder and image size; without scenes."""
    memory: str | int | None = None
    """Keyframes to keep, as for `Map.learn`."""
    options: MapOptions | None = None
    """Sizes and priors of the map."""
    read: Callable[[Path], Recording] = load_recording
    """Reads the copy of a recording at an address; it can be pickled. Its attribute `check`, if it
    has one, refuses a folder of which only small texts are copied yet."""
    results: str | None = None
    """Folder or address where learned scenes are kept: what lies there is not learned again."""

    def done(self, number: int, source: Source) -> Learned:
        """Learn one recording; an unusable one becomes an outcome."""
        try:
            file = self.result_of(source)
            learned = None
            if file is not None and addresses.exists(file):
                learned = _kept(file, source.name)
            if not learned:
                learned = self._learn(source)
                if file is not None:
                    _keep(file, self.contents, *learned)
        except InputError as error:
            return Learned(number, error=str(error))
        return Learned(number, *learned)

    def failed(self, number: int, source: Source, error: str) -> Learned:
        """The outcome for a recording whose process ended."""
        return Learned(number, error=error)

    def _learn(self, source: Source) -> tuple[SceneMap, LearnReport]:
        if isinstance(source, Recording):
            return learn_scene(source, self.contents, self.memory, options=self.options)
        check = getattr(self.read, "check", Path)
        with addresses.local_copy(source.address, check) as copy:
            return self._learn(named_recording(self.read(copy), source.name, ()))

    def result_of(self, source: Source) -> str | None:
        """Address of the result: another recording, option or version gets another one."""
        if self.results is None:
            return None
        what = source
        if isinstance(source, RecordingAt):
            what = self.read, addresses.stamps(source.address)
        of = pickle.dumps(
            (version("evercal"), self.contents, self.memory, self.options, what)
        )
        return f"{self.results}/{source.name}-{hashlib.sha256(of).hexdigest()[:16]}.zip"


def _keep(
    file: str, contents: MapContents, scene: SceneMap, report: LearnReport
) -> None:
    with tempfile.TemporaryDirectory(prefix="evercal-") as folder:
        root = Path(folder, "map")
        packed = Path(folder, "map.zip")
        stored = {**report.to_dict(), _RESULT: _result_name(file)}
        MapStore(root, contents.empty()).commit(scene, stored)
        pack_map(root, packed)
        addresses.put(packed, file)


def _kept(file: str, name: str) -> tuple[SceneMap, LearnReport] | None:
    """The result in a file; None, with a warning, if it is not that of this recording."""
    with addresses.local_copy(file) as packed, tempfile.TemporaryDirectory() as folder:
        try:
            return _unpacked(packed, Path(folder, "map"), name, _result_name(file))
        except InputError as error:
            result = _result_name(file)
            logging.getLogger(__name__).warning(
                "%s is not the result of %s (%s); the recording is learned again",
                printable(result),
                printable(name),
                str(error).replace(str(packed), result),
            )
            return None


def _unpacked(
    packed: Path, root: Path, name: str, result: str
) -> tuple[SceneMap, LearnReport]:
    unpack_map(packed, root)
    store = MapStore.open(root)
    scenes = store.contents.scenes
    if [scene.name for scene in scenes] != [name]:
        names = ", ".join(scene.name for scene in scenes)
        raise InputError(f"it holds {names or 'no scene'}")
    stored = store.reports()[0]
    if stored.get(_RESULT) != result:
        raise InputError(f"it was written as {stored.get(_RESULT)!r}")
    (scene,) = scenes
    every = np.arange(len(scene.keyframes))  # taken out of the file, which goes
    scene = replace(scene, keyframes=scene.keyframes.take(every))
    try:
        return scene, LearnReport.from_stored(stored)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"its report is broken: {error!r}") from None


def _result_name(file: str) -> str:
    return file.rpartition("/")[2]
