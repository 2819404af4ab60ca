"""`StageStore`: a folder that grows by whole stages.

    STORE/
      manifest.json         written last, by atomic replace; sha256 of every file
      NETWORK-SHA.safetensors
      stages/0001-NAME/     files of one stage

A file that the manifest does not list is not part of the store. One process writes at a time, under
a lock beside the folder. Readers need no lock: they read again if a writer replaced files.
What the files mean is up to the kind of store: a map or networks.
"""

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from evercal.errors import InputError
from evercal.storage.atomic import replace_folder, write_json
from evercal.storage.manifest import MANIFEST, Manifest, write_manifest

SCHEMA = 6
STAGES = "stages"
REPORT = "report.json"
_STAGE = re.compile(r"\d{4,}-[\w.~-]*")
_MADE = "made"
"""Key of the payload: the stages ever added. No name is used again after its stage was removed."""
Result = TypeVar("Result")
Write = Callable[[Path], None]
"""Writes the files of a stage into a folder."""


def is_store(root: Path) -> bool:
    """Whether a folder holds a store."""
    return (root / MANIFEST).is_file()


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
        raise InputError(f"store {root}: schema {schema!r} is not {SCHEMA}; update evercal")
    problems = manifest.problems(root)
    if problems:
        raise InputError(f"store {root}: {problems[0]}; restore it from a copy")
    for name in _listed(root, manifest, "networks"):
        if name not in manifest.files:
            raise InputError(f"store {root}: network {name!r} is not in the manifest; restore it")
    for name in _listed(root, manifest, "stages"):
        if not isinstance(name, str) or not _STAGE.fullmatch(name):
            raise InputError(f"store {root}: stage {name!r} is not a stage's name; restore it")


def _listed(root: Path, manifest: Manifest, key: str) -> list[object]:
    names = manifest.payload.get(key, [])
    if not isinstance(names, list):
        raise InputError(f"store {root}: {key!r} in the manifest is not a list; restore it")
    return names


class StageStore:
    """Stages on disk.

    Nothing is written before the first stage is added. All stages share the networks.
    """

    def __init__(self, root: Path, stages: Sequence[str], networks: Sequence[str]):
        self.root, self.stages, self.networks = root, list(stages), tuple(networks)
        resolved = root.resolve()  # one lock, whichever name the store is opened by
        self._lock = FileLock(resolved.parent / f".{resolved.name}.lock")

    def folder(self, stage: str) -> Path:
        """Folder of a stage."""
        return self.root / STAGES / stage

    @contextmanager
    def writing(self) -> Iterator[Manifest | None]:
        """Keep other writers out while this store is changed.

        Yields:
            The manifest that will be replaced; None for a new store.
        """
        # The lock file is never removed: a process that waits for it would lock a deleted file.
        lock = Path(self._lock.lock_file)
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InputError(
                f"store {self.root}: another process is writing into it; wait until it has finished"
            ) from None
        except OSError as error:
            raise InputError(f"store {self.root}: cannot be written ({error.strerror})") from error
        try:
            before = Manifest.read(self.root) if is_store(self.root) else None
            if self.stages != (before.payload["stages"] if before else []):
                raise InputError(f"store {self.root}: another process has changed it; run it again")
            yield before
        finally:
            self._lock.release()

    def add(
        self,
        name: str,
        write: Write,
        payload: Mapping[str, object],
        superseded: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Add a stage: whole, or not at all; see `change`."""
        self.change(self.stages, [(name, write)], payload, superseded)

    def change(
        self,
        kept: Sequence[str],
        added: Sequence[tuple[str, Write]],
        payload: Mapping[str, object],
        superseded: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Keep some stages and add others after them, in one step: all of it, or nothing.

        Args:
            kept: Stages to keep, in order; the others are removed.
            added: Name and writer of each new stage. The writer fills an empty folder. Characters
                of the name that a folder cannot hold are replaced.
            payload: Settings of the store.
            superseded: Files of kept stages that are dropped.
        """
        with self.writing() as before:
            made, new = _made(before), []
            for number, (name, write) in enumerate(added, made + 1):
                legal = re.sub(r"[^\w.-]", "_", name)[:60]
                new.append(f"{number:04d}-{legal}")
                write(self._empty(new[-1]))
            settings = {**payload, _MADE: made + len(new)}
            self._publish([*kept, *new], new, settings, before, superseded)

    def replace(self, index: int, write: Write, payload: Mapping[str, object]) -> None:
        """Replace a stage: whole, or not at all.

        `write` changes files in a copy of the stage's folder.
        """
        old = self.stages[index]
        stem, _, version = old.partition("~")
        stage = f"{stem}~{int(version or 1) + 1}"
        with self.writing() as before:
            assert before is not None, "a store with stages has a manifest"
            _check(self.root, before)  # copies get checksums of their own
            temporary = self._empty(stage)
            for file in before.files:
                if file.startswith(f"{STAGES}/{old}/"):
                    shutil.copyfile(self.root / file, temporary / Path(file).name)
            write(temporary)
            stages = [*self.stages[:index], stage, *self.stages[index + 1 :]]
            settings = {**payload, _MADE: _made(before)}
            self._publish(stages, [stage], settings, before, lambda _: False)

    def reports(self) -> list[dict[str, Any]]:
        """`report.json` of every stage, in order."""
        return [json.loads((self.folder(name) / REPORT).read_text()) for name in self.stages]

    def size_bytes(self) -> dict[str, int]:
        """Size on disk of every file in the manifest, by relative path."""
        manifest = Manifest.read(self.root)
        return {file: int(str(record["bytes"])) for file, record in manifest.files.items()}

    def _empty(self, stage: str) -> Path:
        folder = self.folder(f".{stage}")
        shutil.rmtree(folder, ignore_errors=True)  # left by a writer that was killed
        folder.mkdir(parents=True)
        return folder

    def _publish(
        self,
        stages: list[str],
        new: Sequence[str],
        payload: Mapping[str, object],
        before: Manifest | None,
        superseded: Callable[[str], bool],
    ) -> None:
        files = [*self.networks]
        for stage in new:
            replace_folder(self.folder(f".{stage}"), self.folder(stage))
            files += [f"{STAGES}/{stage}/{path.name}" for path in self.folder(stage).iterdir()]
        for file in before.files if before else ():
            stage, _, name = file.removeprefix(f"{STAGES}/").partition("/")
            if stage in stages and stage not in new and not superseded(name):
                files.append(file)
        settings = {"schema": SCHEMA, **payload, "networks": list(self.networks), "stages": stages}
        write_manifest(self.root, settings, files, before)
        self.stages = stages
        self._tidy(set(files))

    def _tidy(self, files: set[str]) -> None:
        for folder in (self.root / STAGES).iterdir():
            if folder.name not in self.stages:
                if _STAGE.fullmatch(folder.name.removeprefix(".")):
                    shutil.rmtree(folder, ignore_errors=True)
                continue
            for path in folder.iterdir():
                if f"{STAGES}/{folder.name}/{path.name}" not in files:
                    path.unlink(missing_ok=True)
        for unfinished in self.root.glob(".*.tmp"):
            unfinished.unlink(missing_ok=True)


def _made(manifest: Manifest | None) -> int:
    return (
        0 if manifest is None else int(manifest.payload.get(_MADE, len(manifest.payload["stages"])))
    )


def write_report(folder: Path, report: Mapping[str, object]) -> None:
    """Write `report.json` of a stage."""
    write_json(folder / REPORT, report)
