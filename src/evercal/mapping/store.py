"""`Store`: the only code that knows what a store contains. It opens without anything that learns.

    STORE/
      manifest.json                 written last, by atomic replace; sha256 of every file
      encoder-SHA.safetensors       the networks that the stages were made with
      descriptor-SHA.safetensors
      vlad-SHA.safetensors          where maps are made with another encoder than the shipped one
      stages/0001-NAME/
        scene.json                  camera, cell, thresholds
        head.safetensors            weights (fp16, centres fp32); of a shared head only the
                                    newest stage's remains
        memory.safetensors          remembered frames
        notes.safetensors           what else the strategy keeps of the scene
        prototypes.safetensors
        report.json
      learning/                     checkpoints of an interrupted stage

What the manifest does not list is no part of the store. One process at a time writes into it; a
lock beside the folder keeps others out. Readers need none.
"""

import hashlib
import json
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from filelock import FileLock, Timeout
from torch import Tensor, nn

from evercal.continual.networks.descriptor import PooledDescriptor, descriptor_for, load_descriptor
from evercal.errors import InputError
from evercal.features.encoder import Encoder, checked_encoder, load_encoder
from evercal.features.vlad import load_centroids, save_centroids, shipped_centroids
from evercal.features.weights_file import network_bytes
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.mapping.stage_files import (
    HEAD,
    load_tensors,
    own_encoder,
    read_head,
    read_record,
    save_tensors,
    write_head,
    write_record,
)
from evercal.storage.atomic import replace_folder, write_bytes, write_json
from evercal.storage.manifest import MANIFEST, Manifest, write_manifest

SCHEMA = 3
LEARNING = "learning"
STAGES = "stages"
MEMORY_FILES = ("memory.safetensors", "notes.safetensors")
STAGE_FILES = (HEAD, *MEMORY_FILES, "prototypes.safetensors", "report.json", "scene.json")


@dataclass
class Checkpoint:
    """A state from which learning can go on; only what is new since the last one."""

    rows: Mapping[str, Tensor]
    """Feature rows encoded since the last checkpoint; empty when there are none."""
    trainer: Mapping[str, Tensor]
    """State of the training; empty while the encoder is at work."""


@dataclass
class Resume:
    """What checkpoints left behind."""

    rows: Sequence[Mapping[str, Tensor]]
    """The `rows` of all checkpoints in order."""
    trainer: Mapping[str, Tensor]
    """The last non-empty `trainer`."""


class Store:
    """A store on disk and what it knows.

    Args:
        root: folder of the store.
        maps: what it knows.
        stages: folder names of the stages, in order.
        networks: file names of encoder and descriptor, and of centroids where there are some.
    """

    def __init__(
        self, root: Path, maps: SceneMaps, stages: list[str], networks: tuple[str, ...] | None
    ):
        self.root, self.maps, self.stages, self.networks = root, maps, stages, networks
        place = root.resolve()  # one lock, by whatever name the store is called
        self._lock = FileLock(place.parent / f".{place.name}.lock")

    @classmethod
    def create(
        cls,
        root: Path,
        strategy: str,
        short_side: int = 240,
        encoder: Path | nn.Module | None = None,
    ) -> Self:
        """An empty store; nothing is written before the first `commit`.

        Args:
            root: folder of the store to be.
            strategy: name of how scenes are learned into it; code that learns knows what it means.
            short_side: working size of images, pixels.
            encoder: another encoder than the shipped one: a file (its sibling
                `descriptor.safetensors` is taken too, if it fits), or any module that is an
                `Encoder`; `open` then needs the module again.

        Raises:
            InputError: `root` holds something that is not a store, or a bad encoder.
        """
        if root.exists() and not _free(root):
            raise InputError(f"store {root}: exists and is not an evercal store; give another path")
        if encoder is None:
            networks = load_encoder(), load_descriptor()
        elif isinstance(encoder, Path):
            found = load_encoder(encoder)
            networks = found, descriptor_for(encoder, found.width)
        else:
            networks = checked_encoder(encoder), PooledDescriptor(checked_encoder(encoder).width)
        return cls(root, SceneMaps(*networks, strategy, short_side), [], None)

    @classmethod
    def open(cls, root: Path, encoder: nn.Module | None = None) -> Self:
        """Opens a store at its last complete stage.

        Args:
            root: folder of the store.
            encoder: only for a store made with a module of one's own: that module; its weights are
                replaced by those in the store.

        Raises:
            InputError: not a store, a file missing or not matching its checksum.
        """
        while True:
            manifest = Manifest.read(root)
            try:
                return cls._opened(root, manifest, encoder)
            except (InputError, OSError):
                # Where a writer has replaced files meanwhile, nothing is wrong with the store.
                if Manifest.read(root) == manifest:
                    raise

    @classmethod
    def _opened(cls, root: Path, manifest: Manifest, encoder: nn.Module | None) -> Self:
        payload = manifest.payload
        _check_files(root, manifest)
        schema = payload.get("schema")
        if isinstance(schema, int) and schema < SCHEMA:
            raise InputError(
                f"store {root}: schema {schema} is of an earlier evercal; learn the scenes again"
                " into a new store"
            )
        if schema != SCHEMA:
            raise InputError(f"store {root}: schema {schema!r} is not {SCHEMA}; update evercal")
        local, descriptor = (str(name) for name in payload["networks"])
        maps = SceneMaps(
            load_encoder(root / local) if encoder is None else own_encoder(encoder, root / local),
            load_descriptor(root / descriptor),
            str(payload["strategy"]),
            int(payload["short_side"]),
        )
        centroids = tuple(str(name) for name in payload.get("centroids", []))
        for name in centroids:
            load_centroids(maps.encoder, root / name)
        stages = [str(name) for name in payload["stages"]]
        for name in stages:
            folder = root / STAGES / name
            maps.scenes.append(read_record(folder))
            kept, state = (
                load_tensors(folder / file) if f"{STAGES}/{name}/{file}" in manifest.files else {}
                for file in MEMORY_FILES
            )
            maps.keyframes.append(Keyframes.from_tensors(kept) if kept else None)
            maps.method_states.append(state)
            if f"{STAGES}/{name}/{HEAD}" in manifest.files:
                maps.heads.append(read_head(folder, maps.encoder.width))
        return cls(root, maps, stages, (local, descriptor, *centroids))

    @contextmanager
    def writing(self) -> Iterator[Manifest | None]:
        """Keeps every other writer out, for as long as this store is being changed.

        `commit` and `replace_record` do so by themselves; who works long for what they will write
        does it before.

        Yields:
            The manifest that will be replaced; None where there is none yet.

        Raises:
            InputError: another process is writing into the store, or has done so since it was
                opened; it cannot be written.
        """
        lock = Path(self._lock.lock_file)
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(timeout=0)
        except Timeout:
            raise InputError(
                f"store {self.root}: another process is learning into it or aligning it; wait until"
                " it has finished"
            ) from None
        except OSError as error:
            raise InputError(f"store {self.root}: cannot be written ({error.strerror})") from error
        try:
            known = (self.root / MANIFEST).exists()
            before = Manifest.read(self.root) if known else None
            if self.stages != (before.payload["stages"] if before else []):
                raise InputError(
                    f"store {self.root}: another process has changed it meanwhile; run this again"
                )
            yield before
        finally:
            if self._lock.lock_counter == 1:
                lock.unlink(missing_ok=True)
            self._lock.release()

    def commit(self, maps: SceneMaps, report: Mapping[str, object]) -> None:
        """Adds the newest scene of `maps` to the store: whole, or not at all.

        Args:
            maps: the outcome of a stage.
            report: what `report.json` says.

        Raises:
            InputError: as `writing`.
        """
        record, keyframes = maps.scenes[-1], maps.keyframes[-1]
        # A scene may be called anything, a folder may not.
        legal = re.sub(r"[^\w.-]", "_", record.name)[:60]
        name = f"{len(self.stages) + 1:04d}-{legal}"
        with self.writing() as before:
            folder = self._fresh(name)
            self.networks = self.networks or self._write_networks(maps)
            if keyframes is not None and keyframes.descriptors is not None:
                self.networks = self._with_centroids(maps.encoder, self.networks)
            write_record(folder, record)
            if maps.heads:
                write_head(folder, maps.heads[-1])
            if keyframes is not None:
                save_tensors(folder / "memory.safetensors", keyframes.to_tensors())
            if maps.method_states[-1]:
                save_tensors(folder / "notes.safetensors", maps.method_states[-1])
            write_json(folder / "report.json", report)
            self._publish(maps, [*self.stages, name], name, before)
            shutil.rmtree(self.root / LEARNING, ignore_errors=True)

    def replace_record(self, scene: str, record: SceneRecord) -> None:
        """Puts another record in the place of a scene's: whole, or not at all.

        Args:
            scene: name of the scene.
            record: its new record.

        Raises:
            InputError: as `writing`, and where a file is missing or was changed.
        """
        index = [known.name for known in self.maps.scenes].index(scene)
        old = self.stages[index]
        number, _, name = old.partition("-")
        plain, _, version = name.partition("~")
        new = f"{number}-{plain}~{int(version or 1) + 1}"
        with self.writing() as before:
            assert before is not None, "a store with stages has a manifest"
            _check_files(self.root, before)  # copies are listed with checksums of their own
            folder = self._fresh(new)
            for file in STAGE_FILES:
                if f"{STAGES}/{old}/{file}" in before.files:
                    shutil.copyfile(self.root / STAGES / old / file, folder / file)
            write_record(folder, record)
            stages = [*self.stages[:index], new, *self.stages[index + 1 :]]
            self._publish(self.maps, stages, new, before)
            self.maps.scenes[index] = record

    def _fresh(self, stage: str) -> Path:
        """An empty folder in which a stage is made ready."""
        folder = self.root / STAGES / f".{stage}"
        shutil.rmtree(folder, ignore_errors=True)  # left by a commit that was killed
        folder.mkdir(parents=True)
        return folder

    def _publish(
        self, maps: SceneMaps, stages: list[str], new: str, before: Manifest | None
    ) -> None:
        """Puts a new stage in place and writes the manifest; from then on `stages` are the store.

        The other stages keep the files that the manifest lists of them.
        """
        assert self.networks is not None, "a store with stages has its networks"
        folder, shared = self.root / STAGES / new, len(maps.heads) == 1
        replace_folder(self.root / STAGES / f".{new}", folder)
        made = [file for file in STAGE_FILES if (folder / file).exists()]
        listed = [*self.networks, *(f"{STAGES}/{new}/{file}" for file in made)]
        for file in before.files if before else ():
            stage, _, name = file.removeprefix(f"{STAGES}/").partition("/")
            superseded = shared and stage != stages[-1] and name == HEAD
            if stage in stages and not superseded:
                listed.append(file)
        payload = {
            "schema": SCHEMA,
            "strategy": maps.strategy,
            "short_side": maps.short_side,
            "networks": list(self.networks[:2]),
            "centroids": list(self.networks[2:]),
            "stages": stages,
        }
        write_manifest(self.root, payload, listed, before)
        self.maps, self.stages = maps, stages
        self._tidy(shared)

    def _tidy(self, shared: bool) -> None:
        """Removes what nothing refers to any more, also what killed commits left."""
        if shared:
            for stage in self.stages[:-1]:
                (self.root / STAGES / stage / HEAD).unlink(missing_ok=True)
        for folder in (self.root / STAGES).iterdir():
            if folder.name not in self.stages and re.match(r"\.?\d{4}-", folder.name):
                shutil.rmtree(folder, ignore_errors=True)
        for unfinished in self.root.glob(".*.tmp"):
            if unfinished.name.startswith((f".{MANIFEST}", ".encoder", ".descriptor", ".vlad")):
                unfinished.unlink(missing_ok=True)

    def _with_centroids(self, encoder: Encoder, networks: tuple[str, ...]) -> tuple[str, ...]:
        """File names of the networks, with the centroids that descriptors are made with.

        The shipped encoder's are at hand; others take seconds to fit, and from weights in half
        precision come out a little different.
        """
        first, *others = networks
        if len(others) > 1 or shipped_centroids(encoder) is not None:
            return networks
        name = first.replace("encoder", "vlad", 1)
        save_centroids(encoder, self.root / name)
        return *networks, name

    def _write_networks(self, maps: SceneMaps) -> tuple[str, ...]:
        names = []
        for kind, module in (("encoder", maps.encoder), ("descriptor", maps.descriptor)):
            assert isinstance(module, torch.nn.Module)
            data = network_bytes(module, kind)
            names.append(f"{kind}-{hashlib.sha256(data).hexdigest()[:12]}.safetensors")
            write_bytes(self.root / names[-1], data)
        return tuple(names)

    def begin(self, identity: Mapping[str, object]) -> Resume | None:
        """Starts or picks up a stage.

        Args:
            identity: all that the stage depends on (scene, options, seed, stage number).

        Returns:
            The checkpoints of an interrupted run of the same stage; None for a fresh start.
        """
        folder, asked = self.root / LEARNING, json.loads(json.dumps(identity))
        try:
            found = json.loads((folder / "stage.json").read_text())
        except (OSError, ValueError):
            found = None
        if found != asked:
            # First the name, so that half a removal is never taken for a stage to resume.
            (folder / "stage.json").unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            write_json(folder / "stage.json", asked)
            return None
        rows = [load_tensors(path) for path in sorted(folder.glob("rows-*.safetensors"))]
        trainer = folder / "trainer.safetensors"
        if not rows:
            return None
        return Resume(rows, load_tensors(trainer) if trainer.exists() else {})

    def abandon(self) -> None:
        """Drops the stage under way, and the folder too if nothing else was ever stored in it."""
        shutil.rmtree(self.root / LEARNING, ignore_errors=True)
        with suppress(OSError):  # it holds something, or is called `.`
            self.root.rmdir()

    def checkpoint(self, checkpoint: Checkpoint) -> None:
        """Writes a checkpoint of the stage under way."""
        folder = self.root / LEARNING
        if checkpoint.rows:
            number = len(list(folder.glob("rows-*.safetensors")))
            save_tensors(folder / f"rows-{number:05d}.safetensors", checkpoint.rows)
        if checkpoint.trainer:
            save_tensors(folder / "trainer.safetensors", checkpoint.trainer)

    def report(self) -> dict[str, Any]:
        """What `commit` was told about the newest stage."""
        return self.reports()[-1]

    def reports(self) -> list[dict[str, Any]]:
        """The same about every stage, in order."""
        folders = [self.root / STAGES / name for name in self.stages]
        return [json.loads((folder / "report.json").read_text()) for folder in folders]

    def bytes(self) -> dict[str, int]:
        """Size on disk: `memory` (what replay keeps) and `rest` (all else in the manifest)."""
        files = [self.root / MANIFEST, *(self.root / name for name in self.networks or ())]
        for stage in self.stages:
            files += [self.root / STAGES / stage / file for file in STAGE_FILES]
        sizes = {file: file.stat().st_size for file in files if file.exists()}
        memory = sum(size for file, size in sizes.items() if file.name in MEMORY_FILES)
        return {"memory": memory, "rest": sum(sizes.values()) - memory}


def _check_files(root: Path, manifest: Manifest) -> None:
    problems = manifest.problems(root)
    if problems:
        raise InputError(f"store {root}: {problems[0]}; restore it from a copy")


def _free(root: Path) -> bool:
    """Whether a store may be made here: nothing there, or a first stage that was interrupted."""
    if not root.is_dir():
        return False
    names = [path.name for path in root.iterdir()]
    ours = re.compile(
        rf"{LEARNING}|{STAGES}|(encoder|descriptor|vlad)(-\w+)?\.safetensors|\..*\.tmp"
    )
    return not names or (LEARNING in names and all(map(ours.fullmatch, names)))
