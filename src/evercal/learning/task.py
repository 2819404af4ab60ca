"""One of many recordings: what is learned, by whichever process, and where the result is kept."""

import hashlib
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from evercal.errors import InputError
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
Item = tuple[int, Source]
"""A recording with its place among those given."""


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
            file = self.result_of(source)
            if file is not None and addresses.exists(file):
                return Learned(number, *_kept(file))
            learned = self._learn(source)
            if file is not None:
                _keep(file, self.contents, *learned)
        except InputError as error:
            return Learned(number, error=str(error))
        return Learned(number, *learned)

    def _learn(self, source: Source) -> tuple[SceneMap, LearnReport]:
        if isinstance(source, Recording):
            return learn_scene(source, self.contents, self.memory, options=self.options)
        with addresses.local_copy(source.address) as copy:
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
        MapStore(root, contents.empty()).commit(scene, report.stored())
        pack_map(root, packed)
        addresses.put(packed, file)


def _kept(file: str) -> tuple[SceneMap, LearnReport]:
    with addresses.local_copy(file) as packed, tempfile.TemporaryDirectory() as folder:
        unpack_map(packed, Path(folder, "map"))
        store = MapStore.open(Path(folder, "map"))
        scene = store.contents.scenes[0]
        report = LearnReport.from_stored(store.reports()[0])
        every = np.arange(len(scene.keyframes))  # taken out of the file, which goes
        return replace(scene, keyframes=scene.keyframes.take(every)), report
