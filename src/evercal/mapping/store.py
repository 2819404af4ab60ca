"""`Store`: the only code that knows what a store contains. It opens without anything that learns.

    STORE/
      manifest.json                 written last, by atomic replace; sha256 of every file
      encoder-SHA.safetensors       the networks that the stages were made with
      descriptor-SHA.safetensors
      stages/0001-NAME/
        scene.json                  camera, cell, thresholds
        head.safetensors            weights (fp16, centres fp32); of a shared head only the
                                    newest stage's remains
        memory.safetensors          remembered frames
        notes.safetensors           what else the strategy keeps of the scene
        prototypes.safetensors
        report.json
      learning/                     checkpoints of an interrupted stage

What the manifest does not list is no part of the store.
"""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from evercal.errors import InputError
from evercal.features.descriptor import PooledDescriptor, descriptor_for, load_descriptor
from evercal.features.encoder import Encoder, checked_encoder, load_encoder
from evercal.features.weights_file import network_bytes
from evercal.geometry.camera import Camera
from evercal.mapping.atlas import Cell
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.networks.head import Head, HeadOptions
from evercal.storage.atomic import replace_folder, write_bytes, write_json
from evercal.storage.manifest import (
    MANIFEST,
    listed_files,
    read_manifest,
    sha256_file,
    verify,
    write_manifest,
)

SCHEMA = 1
LEARNING = "learning"
STAGES = "stages"
HEAD = "head.safetensors"
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
        networks: file names of encoder and descriptor.
    """

    def __init__(
        self, root: Path, maps: SceneMaps, stages: list[str], networks: tuple[str, str] | None
    ):
        self.root, self.maps, self.stages, self.networks = root, maps, stages, networks

    @classmethod
    def create(
        cls,
        root: Path,
        strategy: str,
        short_side: int = 240,
        encoder: Path | nn.Module | None = None,
    ) -> Self:
        """A robot that knows nothing yet; nothing is written before the first `commit`.

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
        payload = read_manifest(root)
        problems = verify(root)
        if problems:
            raise InputError(f"store {root}: {problems[0]}; restore it from a copy")
        if payload.get("schema") != SCHEMA:
            raise InputError(f"store {root}: schema {payload.get('schema')!r} is not {SCHEMA}")
        networks = payload["networks"]
        local, descriptor = (str(name) for name in networks)  # type: ignore[attr-defined]
        maps = SceneMaps(
            load_encoder(root / local) if encoder is None else _own(encoder, root / local),
            load_descriptor(root / descriptor),
            str(payload["strategy"]),
            int(payload["short_side"]),  # type: ignore[call-overload]
        )
        stages = [str(name) for name in payload["stages"]]  # type: ignore[attr-defined]
        listed = listed_files(root)
        for name in stages:
            folder = root / STAGES / name
            maps.scenes.append(_read_record(folder))
            memory = folder / "memory.safetensors"
            maps.keyframes.append(
                Keyframes.from_tensors(_load(memory)) if memory.exists() else None
            )
            method_states = folder / "notes.safetensors"
            maps.method_states.append(_load(method_states) if method_states.exists() else {})
            if f"{STAGES}/{name}/{HEAD}" in listed:
                maps.heads.append(_read_head(folder, maps))
        return cls(root, maps, stages, (local, descriptor))

    def commit(self, maps: SceneMaps, report: Mapping[str, object]) -> None:
        """Adds the newest scene of `maps` to the store: whole, or not at all.

        Args:
            maps: the outcome of a stage.
            report: what `report.json` says.
        """
        record, memory = maps.scenes[-1], maps.keyframes[-1]
        # A scene may be called anything, a folder may not.
        legal = re.sub(r"[^\w.-]", "_", record.name)[:60]
        name = f"{len(self.stages) + 1:04d}-{legal}"
        folder = self.root / STAGES / f".{name}"
        shutil.rmtree(folder, ignore_errors=True)  # left by a commit that was killed
        folder.mkdir(parents=True)
        if self.networks is None:
            self.networks = self._write_networks(maps)
        _write_record(folder, record)
        _save(folder / "prototypes.safetensors", {"prototypes": record.prototypes})
        if maps.heads:
            _write_head(folder, maps.heads[-1])
        if memory is not None:
            _save(folder / "memory.safetensors", memory.to_tensors())
        if maps.method_states[-1]:
            _save(folder / "notes.safetensors", maps.method_states[-1])
        write_json(folder / "report.json", report)
        replace_folder(folder, self.root / STAGES / name)
        stages = [*self.stages, name]
        shared = len(maps.heads) == 1
        files = [*self.networks]
        for stage in stages:
            for file in STAGE_FILES:
                superseded = shared and stage != name and file == HEAD
                if not superseded and (self.root / STAGES / stage / file).exists():
                    files.append(f"{STAGES}/{stage}/{file}")
        payload = {
            "schema": SCHEMA,
            "strategy": maps.strategy,
            "short_side": maps.short_side,
            "networks": list(self.networks),
            "stages": stages,
        }
        write_manifest(self.root, payload, files)
        # From here on the new stage counts.
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
            if unfinished.name.startswith((f".{MANIFEST}", ".encoder", ".descriptor")):
                unfinished.unlink(missing_ok=True)
        shutil.rmtree(self.root / LEARNING, ignore_errors=True)

    def _write_networks(self, maps: SceneMaps) -> tuple[str, str]:
        names = []
        for kind, module in (("encoder", maps.encoder), ("descriptor", maps.descriptor)):
            assert isinstance(module, torch.nn.Module)
            path = self.root / f"{kind}.safetensors"
            write_bytes(path, network_bytes(module, kind))
            name = f"{kind}-{sha256_file(path)[:12]}.safetensors"
            path.replace(self.root / name)
            names.append(name)
        return names[0], names[1]

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
        rows = [_load(path) for path in sorted(folder.glob("rows-*.safetensors"))]
        trainer = folder / "trainer.safetensors"
        if not rows:
            return None
        return Resume(rows, _load(trainer) if trainer.exists() else {})

    def abandon(self) -> None:
        """Drops the stage under way, and the folder too if nothing else was ever stored in it."""
        shutil.rmtree(self.root / LEARNING, ignore_errors=True)
        if self.root.is_dir() and not any(self.root.iterdir()):
            self.root.rmdir()

    def checkpoint(self, checkpoint: Checkpoint) -> None:
        """Writes a checkpoint of the stage under way."""
        folder = self.root / LEARNING
        if checkpoint.rows:
            number = len(list(folder.glob("rows-*.safetensors")))
            _save(folder / f"rows-{number:05d}.safetensors", checkpoint.rows)
        if checkpoint.trainer:
            _save(folder / "trainer.safetensors", checkpoint.trainer)

    def report(self) -> dict[str, Any]:
        """What was noted with the newest stage."""
        return json.loads((self.root / STAGES / self.stages[-1] / "report.json").read_text())

    def bytes(self) -> dict[str, int]:
        """Size on disk: `memory` (what replay keeps) and `rest` (all else in the manifest)."""
        files = [self.root / MANIFEST, *(self.root / name for name in self.networks or ())]
        for stage in self.stages:
            files += [self.root / STAGES / stage / file for file in STAGE_FILES]
        sizes = {file: file.stat().st_size for file in files if file.exists()}
        memory = sum(size for file, size in sizes.items() if file.name in MEMORY_FILES)
        return {"memory": memory, "rest": sum(sizes.values()) - memory}


def _free(root: Path) -> bool:
    """Whether a store may be made here: nothing there, or a first stage that was interrupted."""
    if not root.is_dir():
        return False
    names = [path.name for path in root.iterdir()]
    ours = re.compile(rf"{LEARNING}|{STAGES}|(encoder|descriptor)(-\w+)?\.safetensors|\..*\.tmp")
    return not names or (LEARNING in names and all(map(ours.fullmatch, names)))


def _own(module: nn.Module, path: Path) -> Encoder:
    """A user's module with the weights that the store keeps of it."""
    try:
        module.load_state_dict({k: v.float() for k, v in _load(path).items()}, strict=True)
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise InputError(f"{path}: not the weights of the encoder given ({first})") from None
    return checked_encoder(module)


def head_bytes(head: Head) -> int:
    """Size of a head as it is stored: weights in half precision, centres in single."""
    return sum(value.nbytes for value in _stored(head).values())


def _stored(head: Head) -> dict[str, Tensor]:
    # Centres stay fp32: half floats are 4 to 16 mm apart at the size of an atlas.
    return {
        key: value if key == "centres" or not value.is_floating_point() else value.half()
        for key, value in head.state_dict().items()
    }


def _write_head(folder: Path, head: Head) -> None:
    settings = {
        "options": asdict(head.options),
        "features": head.features,
        "descriptor": head.descriptor,
    }
    _save(folder / HEAD, _stored(head), {"head": json.dumps(settings)})


def _read_head(folder: Path, maps: SceneMaps) -> Head:
    from safetensors import safe_open

    path = folder / HEAD
    state = _load(path)
    with safe_open(path, "pt") as file:
        settings = json.loads((file.metadata() or {})["head"])
    head = Head(settings["features"], settings["descriptor"], HeadOptions(**settings["options"]))
    if head.features != maps.encoder.width:
        raise InputError(f"{path}: made with another encoder than the store's")
    for name in ("code", "logit", "logit_bias", "offset", "offset_bias"):
        setattr(head, name, torch.nn.Parameter(torch.zeros(state[name].shape)))
    head.centres, head.centre_scene = state["centres"], state["centre_scene"]
    head.load_state_dict(
        {key: v.float() if v.dtype == torch.half else v for key, v in state.items()}
    )
    return head.eval()


def _write_record(folder: Path, record: SceneRecord) -> None:
    content = {
        "name": record.name,
        "camera": record.camera.to_dict(),
        "cell": asdict(record.cell),
        "train_frames": record.train_frames,
        "refined_camera": record.refined_camera.to_dict() if record.refined_camera else None,
        "inlier_threshold": record.inlier_threshold,
        "covariance_scale": record.covariance_scale,
    }
    write_json(folder / "scene.json", content)


def _read_record(folder: Path) -> SceneRecord:
    content = json.loads((folder / "scene.json").read_text())
    cell, refined = content["cell"], content["refined_camera"]
    return SceneRecord(
        content["name"],
        Camera.from_dict(content["camera"]),
        Cell(tuple(cell["centre_m"]), cell["side_m"], tuple(cell["origin_m"])),
        _load(folder / "prototypes.safetensors")["prototypes"],
        content["train_frames"],
        Camera.from_dict(refined) if refined else None,
        content["inlier_threshold"],
        content["covariance_scale"],
    )


def with_fit(record: SceneRecord, inlier_threshold: float, covariance_scale: float) -> SceneRecord:
    """The record with what held-out frames taught."""
    return replace(record, inlier_threshold=inlier_threshold, covariance_scale=covariance_scale)


def _save(
    path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None
) -> None:
    from safetensors.torch import save

    write_bytes(path, save({k: v.detach().contiguous() for k, v in tensors.items()}, metadata))


def _load(path: Path) -> dict[str, Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"{path}: not readable ({error}); run 'evercal verify' on the store"
        ) from None
