"""`StageStore`: a folder that grows by whole stages.

    STORE/
      manifest.json         written last, by atomic replace; sha256 of every file
      NETWORK-SHA.safetensors
      stages/0001-NAME/     files of one stage

A file that the manifest does not list is not part of the store. One process writes at a time, under
a lock beside the folder. Readers need no lock: they read again if a writer replaced files.
What the files mean is up to the kind of store: a map or networks.

A change first writes `.writing`, the names of the stages that it adds and drops, and removes it
last. After a crash the next change removes those that the manifest does not list, and no others.
"""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Generic, TypeVar

from filelock import FileLock, Timeout

from evercal.errors import InputError
from evercal.storage.atomic import replace_folder, write_json
from evercal.storage.manifest import MANIFEST, Manifest, write_manifest
from evercal.storage.text_files import is_link, read_json
from evercal.typing import JsonObject, Record as Payload

SCHEMA = 6
"""Version of the files of a store."""
STAGES = "stages"
"""Folder of the stages."""
REPORT = "report.json"
"""File of a stage."""
_STAGE = re.compile(r"(\d{4,})-[\w.~-]*")
"""Name of a stage: its number and the name that the user gave."""
_JOURNAL = ".writing"
"""File with the stages that a change adds and drops."""
_NEW = Manifest({"stages": []}, {})
"""Manifest of a store that is not written yet."""
_NETWORKS = ("encoder-", "vlad-", "descriptor-")
"""Beginnings of the names of network files."""
_MADE = "made"
"""Key of the payload: the stages ever added. No name is used again after its stage was removed."""
Result = TypeVar("Result")
Contents = TypeVar("Contents")
Names = Sequence[str]
Superseded = Callable[[str], bool]
"""Whether a file of a kept stage, by its name, is dropped."""
Write = Callable[[Path], None]
"""Writes the files of a stage into a folder."""


def is_store(root: Path) -> bool:
    """Whether a folder holds a store."""
    return (root / MANIFEST).is_file()


def require_free(root: Path) -> None:
    """Refuse a path where no store can be made; what a killed writer left does not count."""
    if not root.exists():
        return
    if not root.is_dir() or not all(
        name == STAGES or name.startswith((*_NETWORKS, "."))
        for name in os.listdir(root)
    ):
        raise InputError(
            f"store {root}: exists and is not an evercal store; give another path"
        )
    _require_no_scenes(root)


def _require_no_links(root: Path) -> None:
    """Refuse folders that lie elsewhere: what a change removes there may be another map's."""
    for folder in (root / STAGES, *(root / STAGES).glob("*")):
        if is_link(folder):
            raise InputError(
                f"store {root}: {folder} is a link; copy the whole map instead"
            )


def _require_no_scenes(root: Path) -> None:
    scenes = _names(root / STAGES).difference(_journal(root, "new"))
    if any(not name.startswith(".") for name in scenes):
        raise InputError(
            f"store {root}: holds scenes but no {MANIFEST}; restore it from a copy, or give another"
            " path"
        )


def read_store(root: Path, read: Callable[[Manifest], Result]) -> Result:
    """Read a store; start over when a writer replaces files meanwhile."""
    while True:
        manifest = Manifest.read(root)
        try:
            _check(root, manifest)
            return read(manifest)
        except (InputError, OSError):
            if Manifest.read(root) == manifest:
                raise


def _check(root: Path, manifest: Manifest) -> None:
    schema = manifest.payload.get("schema")
    if isinstance(schema, int) and schema < SCHEMA:
        raise InputError(
            f"store {root}: schema {schema} is of an earlier evercal; learn the scenes again into a"
            " new store"
        )
    if schema != SCHEMA:
        raise InputError(
            f"store {root}: schema {schema!r} is not {SCHEMA}; update evercal"
        )
    if problems := manifest.problems(root):
        raise InputError(f"store {root}: {problems[0]}; restore it from a copy")
    if not isinstance(manifest.payload.get(_MADE, 0), int):
        raise InputError(
            f"store {root}: {_MADE!r} in the manifest is not a number; restore it"
        )
    for name in _listed(root, manifest, "networks"):
        if name not in manifest.files:
            raise InputError(
                f"store {root}: network {name!r} is not in the manifest; restore it"
            )
    for name in _listed(root, manifest, "stages"):
        if not isinstance(name, str) or not _STAGE.fullmatch(name):
            raise InputError(
                f"store {root}: stage {name!r} is not a stage's name; restore it"
            )


def _listed(root: Path, manifest: Manifest, key: str) -> list[object]:
    names = manifest.payload.get(key)
    if not isinstance(names, list):
        raise InputError(
            f"store {root}: {key!r} in the manifest is not a list; restore it"
        )
    return names


class StageStore(Generic[Contents]):
    """Stages on disk, and their contents in memory.

    Nothing is written before the first stage is added. All stages share the networks.
    """

    def __init__(
        self, root: Path, contents: Contents, stages: Names = (), networks: Names = ()
    ):
        self.root = root
        self.contents = contents
        self.stages = list(stages)
        self.networks = tuple(networks)
        resolved = root.resolve()  # one lock, whichever name the store is opened by
        self._lock = FileLock(resolved.parent / f".{resolved.name}.lock")

    def folder(self, stage: str) -> Path:
        """Folder of a stage."""
        return self.root / STAGES / stage

    @contextmanager
    def writing(self) -> Iterator[Manifest]:
        """Keep other writers out while this store is changed.

        Yields:
            The manifest that will be replaced; one without stages for a new store.
        """
        try:
            Path(self._lock.lock_file).parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InputError(
                f"store {self.root}: another process is writing into it; wait until it has finished"
            ) from None
        except OSError as error:
            raise InputError(
                f"store {self.root}: cannot be written ({error.strerror})"
            ) from error
        try:
            _require_no_links(self.root)
            before = _manifest(self.root)
            if self.stages != before.payload["stages"]:
                raise InputError(
                    f"store {self.root}: another process has changed it; run it again"
                )
            if before is _NEW:
                _require_no_scenes(self.root)
            yield before
        finally:
            # Who waits tries again: the file that it has opened has no links any more.
            if self._lock.lock_counter == 1:
                with suppress(PermissionError):  # of Windows, where the file is open
                    Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release()

    def add(
        self,
        name: str,
        write: Write,
        payload: Payload,
        superseded: Superseded = lambda _: False,
    ) -> None:
        """Add a stage: whole, or not at all; see `change`."""
        self.change(self.stages, [(name, write)], payload, superseded)

    def change(
        self,
        kept: Names,
        added: Sequence[tuple[str, Write]],
        payload: Payload,
        superseded: Superseded = lambda _: False,
    ) -> None:
        """Keep some stages and add others after them, in one step: all of it, or nothing.

        Args:
            kept: Stages to keep, in order; the others are removed.
            added: Name and writer of each new stage. The writer fills an empty folder. Characters
                of the name that a folder cannot hold are replaced.
            payload: Settings of the store.
            superseded: Files of kept stages that are dropped.
        """
        with self._changing() as before:
            made = _made(before)
            # A folder that the manifest does not list keeps its name.
            number = made
            for match in map(_STAGE.fullmatch, _names(self.root / STAGES)):
                if match:
                    number = max(number, int(match[1]))
            new = {}
            for name, write in added:
                number += 1
                made = number
                legal = re.sub(r"[^\w.-]|[.]$", "_", name[:60])
                new[f"{number:04d}-{legal}"] = write
            settings = {**payload, _MADE: made}
            self._publish([*kept, *new], new, settings, before, superseded)

    def replace(self, index: int, write: Write, payload: Payload) -> None:
        """Replace a stage: whole, or not at all.

        `write` changes files in a copy of the stage's folder.
        """
        old = self.stages[index]

        def write_copy(folder: Path) -> None:
            for file in before.files:
                if file.startswith(f"{STAGES}/{old}/"):
                    shutil.copyfile(self.root / file, folder / Path(file).name)
            write(folder)

        with self._changing() as before:
            _check(self.root, before)  # copies get checksums of their own
            stem, _, version = old.partition("~")
            number = int(version or 1) + 1
            taken = _names(self.root / STAGES)
            while f"{stem}~{number}" in taken:
                number += 1
            stage = f"{stem}~{number}"
            stages = [*self.stages]
            stages[index] = stage
            settings = {**payload, _MADE: _made(before)}
            self._publish(
                stages, {stage: write_copy}, settings, before, lambda _: False
            )

    def reports(self) -> list[JsonObject]:
        """`report.json` of every stage, in order."""
        return [read_report(self.folder(name)) for name in self.stages]

    def size_bytes(self) -> dict[str, int]:
        """Size on disk of every file in the manifest, by relative path."""
        files = Manifest.read(self.root).files
        return {name: int(record["bytes"]) for name, record in files.items()}

    @contextmanager
    def _changing(self) -> Iterator[Manifest]:
        """As `writing`; a change that is refused leaves no file, on disk or in memory."""
        networks = self.networks
        with self.writing() as before:
            _tidy(self.root)
            folders = [self.root / STAGES, self.root]
            missing = [folder for folder in folders if not folder.exists()]
            names = _names(self.root)
            try:
                yield before
            except BaseException:
                self.networks = networks
                _tidy(self.root)
                if not is_store(self.root):
                    for name in _names(self.root) - names:
                        if name.startswith(_NETWORKS):
                            (self.root / name).unlink(missing_ok=True)
                for folder in missing:
                    with suppress(OSError):  # it is not there, or holds something else
                        folder.rmdir()
                raise
            _tidy(self.root)

    def _publish(
        self,
        stages: list[str],
        new: Mapping[str, Write],
        payload: Payload,
        before: Manifest,
        superseded: Superseded,
    ) -> None:
        self.root.mkdir(parents=True, exist_ok=True)
        # Those of earlier changes may still be open: Windows then removes nothing.
        dropped = {*self.stages, *_left(self.root, self.stages)}.difference(stages)
        journal = {"new": [*new], "dropped": sorted(dropped)}
        write_json(self.root / _JOURNAL, journal)
        for stage, write in new.items():
            self.folder(f".{stage}").mkdir(parents=True)
            write(self.folder(f".{stage}"))
        files = [*self.networks]
        for stage in new:
            folder = self.folder(stage)
            replace_folder(self.folder(f".{stage}"), folder)
            files += [f"{STAGES}/{stage}/{name}" for name in os.listdir(folder)]
        for file in before.files:
            stage, _, name = file.removeprefix(f"{STAGES}/").partition("/")
            if stage in stages and stage not in new and not superseded(name):
                files.append(file)
        settings = {
            "schema": SCHEMA,
            **payload,
            "networks": list(self.networks),
            "stages": stages,
        }
        write_manifest(self.root, settings, files, before)
        self.stages = stages


def _tidy(root: Path) -> None:
    """Remove what a change has dropped, or has left because it was refused or killed."""
    manifest = _manifest(root)
    stages = manifest.payload["stages"]
    left = _left(root, stages)
    for name in _names(root / STAGES):
        folder = root / STAGES / name
        is_unfinished = name.startswith(".") and _STAGE.fullmatch(name[1:])
        if name in left or is_unfinished:
            shutil.rmtree(folder, ignore_errors=True)
        elif name in stages:
            for file in _names(folder):
                if f"{STAGES}/{name}/{file}" not in manifest.files:
                    with suppress(OSError):
                        (folder / file).unlink()
    with suppress(OSError):
        for unfinished in root.glob(".*.tmp"):
            unfinished.unlink()
        if not _left(root, stages):
            (root / _JOURNAL).unlink()


def _left(root: Path, stages: Iterable[str]) -> set[str]:
    """Folders of stages that a change has dropped, or has left without finishing."""
    written = {*_journal(root, "new"), *_journal(root, "dropped")}
    return written.difference(stages) & _names(root / STAGES)


def _manifest(root: Path) -> Manifest:
    if is_store(root):
        return Manifest.read(root)
    return _NEW


def _journal(root: Path, key: str) -> list[str]:
    """Stages in `.writing`; an empty list if another program has written the file."""
    try:
        names = json.loads((root / _JOURNAL).read_bytes())[key]
        return [name for name in names if _STAGE.fullmatch(name)]
    except (OSError, ValueError, TypeError, KeyError):
        return []


def _names(folder: Path) -> set[str]:
    try:
        return {*os.listdir(folder)}
    except OSError:
        return set()


def _made(manifest: Manifest) -> int:
    return int(manifest.payload.get(_MADE, len(manifest.payload["stages"])))


def read_report(folder: Path) -> JsonObject:
    """Read `report.json` of a stage."""
    return read_json(folder / REPORT, "report of a scene", "restore the map")


def write_report(folder: Path, report: Payload) -> None:
    """Write `report.json` of a stage."""
    write_json(folder / REPORT, report)
