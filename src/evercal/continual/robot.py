"""`Robot`: the only code that knows what a store contains.

    STORE/
      manifest.json                 written last, by atomic replace; sha256 of every file
      encoder-SHA.safetensors       the networks that the stages were made with
      descriptor-SHA.safetensors
      stages/0001-NAME/
        scene.json                  camera, cell, thresholds
        head.safetensors            weights (fp16, centres fp32); of a shared head only the
                                    newest stage's remains
        memory.safetensors          remembered frames
        notes.safetensors           what else the strategy noted
        prototypes.safetensors
        report.json
      learning/                     checkpoints of an interrupted stage

What the manifest does not list is no part of the store.
"""

import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from evercal.continual.atlas import Cell
from evercal.continual.knowledge import Knowledge, SceneRecord
from evercal.continual.learn import Checkpoint, Resume
from evercal.continual.memory import Memory
from evercal.continual.strategies import STRATEGIES
from evercal.errors import InputError
from evercal.geometry.camera import Camera
from evercal.models.descriptor import PooledDescriptor, descriptor_for, load_descriptor
from evercal.models.encoder import Encoder, checked_encoder, load_encoder
from evercal.models.head import Head, HeadOptions
from evercal.models.weights_file import network_bytes
from evercal.storage.atomic import replace_folder, write_bytes, write_json
from evercal.storage.manifest import (
    MANIFEST,
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


class Robot:
    """A store on disk and what it knows.

    Args:
        root: folder of the store.
        known: what it knows.
        stages: folder names of the stages, in order.
        networks: file names of encoder and descriptor.
    """

    def __init__(
        self, root: Path, known: Knowledge, stages: list[str], networks: tuple[str, str] | None
    ):
        self.root, self.known, self.stages, self.networks = root, known, stages, networks

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
            strategy: key of STRATEGIES.
            short_side: working size of images, pixels.
            encoder: another encoder than the shipped one: a file (its sibling
                `descriptor.safetensors` is taken too, if it fits), or any module that is an
                `Encoder`; `open` then needs the module again.

        Raises:
            InputError: `root` holds something that is not a store, unknown strategy, bad encoder.
        """
        if root.exists() and not _free(root):
            raise InputError(f"store {root}: exists and is not an evercal store; give another path")
        if strategy not in STRATEGIES:
            known = ", ".join(STRATEGIES)
            raise InputError(f"strategy {strategy!r}: unknown; choose one of {known}")
        if encoder is None:
            networks = load_encoder(), load_descriptor()
        elif isinstance(encoder, Path):
            found = load_encoder(encoder)
            networks = found, descriptor_for(encoder, found.width)
        else:
            networks = checked_encoder(encoder), PooledDescriptor(checked_encoder(encoder).width)
        return cls(root, Knowledge(*networks, strategy, short_side), [], None)

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
        if payload["strategy"] not in STRATEGIES:
            known_ones = ", ".join(STRATEGIES)
            raise InputError(
                f"store {root}: made with strategy {payload['strategy']!r}, this evercal has "
                f"{known_ones}; update evercal"
            )
        networks = payload["networks"]
        local, descriptor = (str(name) for name in networks)  # type: ignore[attr-defined]
        known = Knowledge(
            load_encoder(root / local) if encoder is None else _own(encoder, root / local),
            load_descriptor(root / descriptor),
            str(payload["strategy"]),
            int(payload["short_side"]),  # type: ignore[call-overload]
        )
        stages = [str(name) for name in payload["stages"]]  # type: ignore[attr-defined]
        for name in stages:
            folder = root / STAGES / name
            known.scenes.append(_read_record(folder))
            memory = folder / "memory.safetensors"
            known.memories.append(Memory.from_tensors(_load(memory)) if memory.exists() else None)
            notes = folder / "notes.safetensors"
            known.notes.append(_load(notes) if notes.exists() else {})
            shared = STRATEGIES[known.strategy].heads == "one"
            if not shared or name == stages[-1]:
                known.heads.append(_read_head(folder, known))
        return cls(root, known, stages, (local, descriptor))

    def commit(self, known: Knowledge, report: Mapping[str, object]) -> None:
        """Adds the newest scene of `known` to the store: whole, or not at all.

        Args:
            known: the outcome of a stage.
            report: what `report.json` says.
        """
        record, memory = known.scenes[-1], known.memories[-1]
        # A scene may be called anything, a folder may not.
        legal = re.sub(r"[^\w.-]", "_", record.name)[:60]
        name = f"{len(self.stages) + 1:04d}-{legal}"
        folder = self.root / STAGES / f".{name}"
        shutil.rmtree(folder, ignore_errors=True)  # left by a commit that was killed
        folder.mkdir(parents=True)
        if self.networks is None:
            self.networks = self._write_networks(known)
        _write_record(folder, record)
        _save(folder / "prototypes.safetensors", {"prototypes": record.prototypes})
        _write_head(folder, known.heads[-1])
        if memory is not None:
            _save(folder / "memory.safetensors", memory.to_tensors())
        if known.notes[-1]:
            _save(folder / "notes.safetensors", known.notes[-1])
        write_json(folder / "report.json", report)
        replace_folder(folder, self.root / STAGES / name)
        stages = [*self.stages, name]
        shared = STRATEGIES[known.strategy].heads == "one"
        files = [*self.networks]
        for stage in stages:
            for file in STAGE_FILES:
                superseded = shared and stage != name and file == HEAD
                if not superseded and (self.root / STAGES / stage / file).exists():
                    files.append(f"{STAGES}/{stage}/{file}")
        payload = {
            "schema": SCHEMA,
            "strategy": known.strategy,
            "short_side": known.short_side,
            "networks": list(self.networks),
            "stages": stages,
        }
        write_manifest(self.root, payload, files)
        # From here on the new stage counts.
        self.known, self.stages = known, stages
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

    def _write_networks(self, known: Knowledge) -> tuple[str, str]:
        names = []
        for kind, module in (("encoder", known.encoder), ("descriptor", known.descriptor)):
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
        fitter = folder / "fitter.safetensors"
        if not rows:
            return None
        return Resume(rows, _load(fitter) if fitter.exists() else {})

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
        if checkpoint.fitter:
            _save(folder / "fitter.safetensors", checkpoint.fitter)

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


def _read_head(folder: Path, known: Knowledge) -> Head:
    from safetensors import safe_open

    path = folder / HEAD
    state = _load(path)
    with safe_open(path, "pt") as file:
        settings = json.loads((file.metadata() or {})["head"])
    head = Head(settings["features"], settings["descriptor"], HeadOptions(**settings["options"]))
    if head.features != known.encoder.width:
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
