"""`NetworkStore`: heads, remembered keyframes and method states on disk.

stages/0001-NAME/
  network.json             record of the scene
  head.safetensors         weights (fp16, centres fp32); of a shared head only the newest
                           stage's remains
  prototypes.safetensors
  keyframes.safetensors    remembered frames
  state.safetensors        what else the method keeps of the scene
  report.json
  training.csv             loss, inliers and rate of the training
"""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evercal.continual.networks import descriptor
from evercal.continual.networks.atlas import Cell
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.geometry import Camera
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.store import KEYFRAMES
from evercal.recordings.frame import checked_name
from evercal.storage.atomic import write_bytes, write_json
from evercal.storage.manifest import Manifest
from evercal.storage.stages import (
    STAGES,
    StageStore,
    read_store,
    require_free,
    write_report,
)
from evercal.storage.tensors import load_tensors, save_tensors
from evercal.typing import JsonObject, Record, Strings

HEAD = "head.safetensors"
"""File of the weights of a head."""
RECORD = "network.json"
"""File of the record of a scene."""
PROTOTYPES = "prototypes.safetensors"
"""File of the prototypes of a scene."""
STATE = "state.safetensors"
"""File of what the method keeps of a scene."""


class NetworkStore(StageStore[LearnedScenes]):
    """A store of networks on disk and in memory; its networks are encoder and descriptor."""

    @classmethod
    def create(
        cls,
        root: Path,
        strategy: str,
        short_side: int = 240,
        encoder: Path | None = None,
    ) -> Self:
        """An empty store; nothing is written before the first `commit`.

        By default it has the shipped networks. The sibling `descriptor.safetensors` of another
        encoder's ONNX file is used, if it fits.
        """
        require_free(root)
        file = encoder or descriptor.DESCRIBED_ENCODER
        local = load_encoder(file)
        described = descriptor.descriptor_for(file, local.width)
        return cls(root, LearnedScenes(local, described, strategy, short_side))

    @classmethod
    def open(cls, root: Path) -> Self:
        """Open a store at its last complete scene."""

        def read(manifest: Manifest) -> Self:
            payload = manifest.payload
            networks = tuple(map(str, payload["networks"]))
            encoder = load_encoder(root / networks[0])
            for name in networks[1:-1]:
                centroids = load_tensors(root / name)["centroids"]
                encoder.centroids = centroids.astype(np.float32)
            described = descriptor.load_descriptor(root / networks[-1])
            strategy = str(payload["strategy"])
            short_side = int(payload["short_side"])
            scenes = LearnedScenes(encoder, described, strategy, short_side)
            stages = list(map(str, payload["stages"]))
            store = cls(root, scenes, stages, networks)
            for name in stages:
                store._read_stage(name, manifest)
            return store

        return read_store(root, read)

    def _read_stage(self, name: str, manifest: Manifest) -> None:
        scenes = self.contents
        folder = self.folder(name)

        def listed(file: str) -> bool:
            return f"{STAGES}/{name}/{file}" in manifest.files

        keyframes = None
        if listed(KEYFRAMES):
            keyframes = Keyframes.from_tensors(load_tensors(folder / KEYFRAMES))
        state = {}
        if listed(STATE):
            state = _tensors(folder / STATE)
        scenes.scenes.append(_read_record(folder))
        scenes.keyframes.append(keyframes)
        scenes.method_states.append(state)
        if listed(HEAD):
            scenes.heads.append(_read_head(folder, scenes.encoder.width))

    def commit(
        self, scenes: LearnedScenes, report: Record, curve: Path | None = None
    ) -> None:
        """Add the newest scene of `scenes`, and the curve of its training: whole, or not at all."""
        record = scenes.scenes[-1]
        keyframes = scenes.keyframes[-1]

        def write(folder: Path) -> None:
            if not self.networks:
                self.networks = self._write_networks(scenes)
            write_json(folder / RECORD, _plain(record))
            prototypes = {"prototypes": record.prototypes}
            save_tensors(folder / PROTOTYPES, _arrays(prototypes))
            _write_head(folder, scenes.heads[-1])
            if keyframes is not None:
                save_tensors(folder / KEYFRAMES, keyframes.to_tensors())
            if scenes.method_states[-1]:
                save_tensors(folder / STATE, _arrays(scenes.method_states[-1]))
            write_report(folder, report)
            if curve and curve.is_file():
                shutil.copyfile(curve, folder / curve.name)

        shared = len(scenes.heads) == 1
        payload = {
            "kind": "networks",
            "strategy": scenes.strategy,
            "short_side": scenes.short_side,
        }
        self.add(record.name, write, payload, lambda file: shared and file == HEAD)
        self.contents = scenes

    def _write_networks(self, scenes: LearnedScenes) -> Strings:
        data = descriptor.descriptor_bytes(scenes.descriptor)
        name = f"descriptor-{hashlib.sha256(data).hexdigest()[:12]}.safetensors"
        write_bytes(self.root / name, data)
        return (*scenes.encoder.write(self.root), name)


def describe(path: Path) -> tuple[list[JsonObject], int, int, dict[str, int]]:
    """Scenes for JSON, working size, size of networks, and files with their sizes."""
    store = NetworkStore.open(path)
    contents = store.contents
    scenes = []
    for record, kept in zip(contents.scenes, contents.keyframes, strict=True):
        scene = _plain(record) | {"memory_bytes": 0, "keyframes": 0}
        if kept is not None:
            scene |= {"memory_bytes": kept.bytes, "keyframes": len(kept)}
        scenes.append(scene)
    heads = sum(map(head_bytes, contents.heads))
    return scenes, contents.short_side, heads, store.size_bytes()


def head_bytes(head: Head) -> int:
    """Size of a head as it is stored: weights in half precision, centres in single."""
    return sum(value.nbytes for value in _stored(head).values())


def _stored(head: Head) -> dict[str, Tensor]:
    state = head.state_dict()
    for name, value in state.items():
        # Centres stay fp32: half floats are 4 to 16 mm apart at the size of an atlas.
        if name != "centres" and value.is_floating_point():
            state[name] = value.half()
    return state


def _write_head(folder: Path, head: Head) -> None:
    settings = {
        "options": asdict(head.options),
        "features": head.features,
        "descriptor": head.descriptor,
    }
    save_tensors(folder / HEAD, _arrays(_stored(head)), {"head": json.dumps(settings)})


def _read_head(folder: Path, features: int) -> Head:
    from safetensors import safe_open

    path = folder / HEAD
    state = _tensors(path)
    with safe_open(path, "np") as file:
        settings = json.loads((file.metadata() or {})["head"])
    if settings["features"] != features:
        raise InputError(f"{path}: trained with another encoder than the store's")
    options = HeadOptions(**settings["options"])
    return Head.from_state(features, settings["descriptor"], options, state).eval()


def _arrays(tensors: Mapping[str, Tensor]) -> dict[str, NDArray[Any]]:
    return {name: value.numpy(force=True) for name, value in tensors.items()}


def _tensors(path: Path) -> dict[str, Tensor]:
    return {name: torch.tensor(value) for name, value in load_tensors(path).items()}


def _plain(record: SceneRecord) -> JsonObject:
    """A record as in its file, without its prototypes."""
    content = {**vars(record), "cell": asdict(record.cell)}
    del content["prototypes"]
    content["camera"] = record.camera.to_dict()
    return content


def _read_record(folder: Path) -> SceneRecord:
    content = json.loads((folder / RECORD).read_bytes())
    checked_name(content["name"])
    cell = content["cell"]
    content["cell"] = Cell(
        centre_m=tuple(cell["centre_m"]),
        side_m=cell["side_m"],
        origin_m=tuple(cell["origin_m"]),
    )
    content["camera"] = Camera.from_dict(content["camera"])
    tensors = _tensors(folder / PROTOTYPES)
    return SceneRecord(prototypes=tensors["prototypes"], **content)
