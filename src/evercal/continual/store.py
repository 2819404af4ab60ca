"""`NetworkStore`: heads, remembered keyframes and method states on disk.

stages/0001-NAME/
  network.json             record of the scene
  head.safetensors         weights (fp16, centres fp32); of a shared head only the newest
                           stage's remains
  prototypes.safetensors
  keyframes.safetensors    remembered frames
  state.safetensors        what else the method keeps of the scene
  scene.json, correction.safetensors    of the map, for strategies that build one
  report.json
learning/                  checkpoints of an interrupted stage
"""

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.descriptor import (
    PooledDescriptor,
    descriptor_for,
    load_descriptor,
)
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.errors import InputError
from evercal.features.encoder import checked_encoder, load_encoder, own_encoder
from evercal.features.vlad import load_centroids
from evercal.features.weights_file import network_bytes
from evercal.geometry import Camera
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.store import KEYFRAMES, SCENE, read_scene, write_encoder, write_scene
from evercal.storage.atomic import write_bytes, write_json
from evercal.storage.manifest import Manifest
from evercal.storage.stages import STAGES, StageStore, read_store, write_report
from evercal.storage.tensors import load_tensors, save_tensors

LEARNING = "learning"
HEAD, RECORD = "head.safetensors", "network.json"
PROTOTYPES, STATE = "prototypes.safetensors", "state.safetensors"


@dataclass
class Checkpoint:
    """A state from which learning can continue; only what is new since the last one."""

    rows: Mapping[str, Tensor]
    """Feature rows encoded since the last checkpoint."""
    trainer: Mapping[str, Tensor]
    """State of the training; empty while images are encoded."""


@dataclass
class Resume:
    """The checkpoints of an interrupted stage."""

    rows: Sequence[Mapping[str, Tensor]]
    """The `rows` of all checkpoints in order."""
    trainer: Mapping[str, Tensor]
    """The last non-empty `trainer`."""


class NetworkStore(StageStore):
    """A store of networks on disk and in memory.

    Args:
        root: folder of the store.
        scenes: what was learned.
        stages: folder names of the scenes, in order.
        networks: file names of encoder, centroids of another encoder, and descriptor.
    """

    def __init__(
        self,
        root: Path,
        scenes: LearnedScenes,
        stages: list[str] | None = None,
        networks: tuple[str, ...] = (),
    ):
        super().__init__(root, stages or [], networks)
        self.contents = scenes

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
            strategy: how scenes are learned into it.
            short_side: working size of images, pixels.
            encoder: a weights file (its sibling `descriptor.safetensors` is used, if it fits) or
                any module that is an `Encoder`. Default: the shipped weights.

        Raises:
            InputError: `root` holds something that is not a store, or a bad encoder.
        """
        if root.exists() and not _is_free(root):
            raise InputError(f"store {root}: exists and is not an evercal store; give another path")
        if encoder is None:
            networks = load_encoder(), load_descriptor()
        elif isinstance(encoder, Path):
            local = load_encoder(encoder)
            networks = local, descriptor_for(encoder, local.width)
        else:
            networks = checked_encoder(encoder), PooledDescriptor(checked_encoder(encoder).width)
        return cls(root, LearnedScenes(*networks, strategy, short_side))

    @classmethod
    def open(cls, root: Path, encoder: nn.Module | None = None) -> Self:
        """Open a store at its last complete stage.

        Args:
            root: folder of the store.
            encoder: the module of a store that was made with a module of the caller's own.

        Raises:
            InputError: Not a store, or a file is missing or was changed.
        """

        def read(manifest: Manifest) -> Self:
            payload = manifest.payload
            first, *centroids, descriptor = (str(name) for name in payload["networks"])
            path = root / first
            scenes = LearnedScenes(
                load_encoder(path) if encoder is None else own_encoder(encoder, path),
                load_descriptor(root / descriptor),
                str(payload["strategy"]),
                int(payload["short_side"]),
            )
            for name in centroids:
                load_centroids(scenes.encoder, root / name)
            stages = [str(name) for name in payload["stages"]]
            store = cls(root, scenes, stages, (first, *centroids, descriptor))
            for name in stages:
                store._read_stage(name, manifest)
            return store

        return read_store(root, read)

    def _read_stage(self, name: str, manifest: Manifest) -> None:
        scenes, folder = self.contents, self.folder(name)

        def listed(file: str) -> bool:
            return f"{STAGES}/{name}/{file}" in manifest.files

        scenes.scenes.append(read_record(folder, listed(SCENE)))
        scenes.keyframes.append(
            Keyframes.from_tensors(load_tensors(folder / KEYFRAMES)) if listed(KEYFRAMES) else None
        )
        scenes.method_states.append(load_tensors(folder / STATE) if listed(STATE) else {})
        if listed(HEAD):
            scenes.heads.append(read_head(folder, scenes.encoder.width))

    def commit(self, scenes: LearnedScenes, report: Mapping[str, object]) -> None:
        """Add the newest scene: whole, or not at all.

        Args:
            scenes: the outcome of a stage.
            report: content of its `report.json`.

        Raises:
            InputError: As `StageStore.writing`.
        """
        record, keyframes = scenes.scenes[-1], scenes.keyframes[-1]

        def write(folder: Path) -> None:
            if not self.networks:
                self.networks = self._write_networks(scenes, record.map is not None)
            write_record(folder, record)
            if scenes.heads:
                write_head(folder, scenes.heads[-1])
            if keyframes is not None:
                save_tensors(folder / KEYFRAMES, keyframes.to_tensors())
            if scenes.method_states[-1]:
                save_tensors(folder / STATE, scenes.method_states[-1])
            write_report(folder, report)

        shared = len(scenes.heads) == 1
        payload = {
            "kind": "networks",
            "strategy": scenes.strategy,
            "short_side": scenes.short_side,
        }
        self.add(record.name, write, payload, lambda file: shared and file == HEAD)
        self.contents = scenes
        shutil.rmtree(self.root / LEARNING, ignore_errors=True)

    def _write_networks(self, scenes: LearnedScenes, maps: bool) -> tuple[str, ...]:
        names = write_encoder(self.root, scenes.encoder, centroids=maps)
        assert isinstance(scenes.descriptor, nn.Module), "only modules have weights"
        data = network_bytes(scenes.descriptor, "descriptor")
        name = f"descriptor-{hashlib.sha256(data).hexdigest()[:12]}.safetensors"
        write_bytes(self.root / name, data)
        return (*names, name)

    def begin(self, identity: Mapping[str, object]) -> Resume | None:
        """Start or pick up a stage.

        Args:
            identity: everything that the stage depends on (scene, options, seed, stages).

        Returns:
            The checkpoints of an interrupted run of the same stage; None if there are none.
        """
        folder, current = self.root / LEARNING, json.loads(json.dumps(identity))
        try:
            previous = json.loads((folder / "stage.json").read_text())
        except (OSError, ValueError):
            previous = None
        if previous != current:
            # The name goes first, so that a half-removed stage is never resumed.
            (folder / "stage.json").unlink(missing_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            write_json(folder / "stage.json", current)
            return None
        rows = [load_tensors(path) for path in sorted(folder.glob("rows-*.safetensors"))]
        trainer = folder / "trainer.safetensors"
        if not rows:
            return None
        return Resume(rows, load_tensors(trainer) if trainer.exists() else {})

    def checkpoint(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint of the stage under way."""
        folder = self.root / LEARNING
        if checkpoint.rows:
            number = len(list(folder.glob("rows-*.safetensors")))
            save_tensors(folder / f"rows-{number:05d}.safetensors", checkpoint.rows)
        if checkpoint.trainer:
            save_tensors(folder / "trainer.safetensors", checkpoint.trainer)

    def abandon(self) -> None:
        """Drop the stage under way, and the folder if nothing else is stored in it."""
        shutil.rmtree(self.root / LEARNING, ignore_errors=True)
        with suppress(OSError):  # not empty, or called `.`
            self.root.rmdir()


def _is_free(root: Path) -> bool:
    """Whether a folder is empty, or holds only what a killed writer of a store left."""
    left = (LEARNING, STAGES, "encoder-", "vlad-", "descriptor-", ".")
    return root.is_dir() and all(path.name.startswith(left) for path in root.iterdir())


def head_bytes(head: Head) -> int:
    """Size of a head as it is stored: weights in half precision, centres in single."""
    return sum(value.nbytes for value in _stored(head).values())


def _stored(head: Head) -> dict[str, Tensor]:
    # Centres stay fp32: half floats are 4 to 16 mm apart at the size of an atlas.
    return {
        key: value if key == "centres" or not value.is_floating_point() else value.half()
        for key, value in head.state_dict().items()
    }


def write_head(folder: Path, head: Head) -> None:
    """Write a head into a stage's folder."""
    settings = {
        "options": asdict(head.options),
        "features": head.features,
        "descriptor": head.descriptor,
    }
    save_tensors(folder / HEAD, _stored(head), {"head": json.dumps(settings)})


def read_head(folder: Path, features: int) -> Head:
    """Read a head from a stage's folder; `features` is the width of the store's encoder.

    Raises:
        InputError: The head was trained with another encoder.
    """
    from safetensors import safe_open

    path = folder / HEAD
    state = load_tensors(path)
    with safe_open(path, "pt") as file:
        settings = json.loads((file.metadata() or {})["head"])
    if settings["features"] != features:
        raise InputError(f"{path}: trained with another encoder than the store's")
    options = HeadOptions(**settings["options"])
    return Head.from_state(features, settings["descriptor"], options, state).eval()


def write_record(folder: Path, record: SceneRecord) -> None:
    """Write the record of a scene into a stage's folder."""
    content = {
        "name": record.name,
        "camera": record.camera.to_dict(),
        "cell": asdict(record.cell),
        "train_frames": record.train_frames,
        "refined_camera": record.refined_camera.to_dict() if record.refined_camera else None,
        "inlier_threshold": record.inlier_threshold,
        "covariance_scale": record.covariance_scale,
    }
    write_json(folder / RECORD, content)
    save_tensors(folder / PROTOTYPES, {"prototypes": record.prototypes})
    if record.map is not None:
        write_scene(folder, record.map)


def read_record(folder: Path, has_map: bool) -> SceneRecord:
    """Read the record of a scene from a stage's folder."""
    content = json.loads((folder / RECORD).read_text())
    cell, refined = content["cell"], content["refined_camera"]
    tensors: dict[str, torch.Tensor] = load_tensors(folder / PROTOTYPES)
    return SceneRecord(
        name=content["name"],
        camera=Camera.from_dict(content["camera"]),
        cell=Cell(tuple(cell["centre_m"]), cell["side_m"], tuple(cell["origin_m"])),
        prototypes=tensors["prototypes"],
        train_frames=content["train_frames"],
        refined_camera=Camera.from_dict(refined) if refined else None,
        inlier_threshold=content["inlier_threshold"],
        covariance_scale=content["covariance_scale"],
        map=read_scene(folder) if has_map else None,
    )
