"""`MapStore`: a map on disk.

stages/0001-NAME/
  scene.json               cameras, unit, relation to the base frame
  keyframes.safetensors    images, poses, depths, landmarks, descriptors
  correction.safetensors   slowly varying corrections, where there are any
  report.json
  refreshes.json           reports of refreshes, and previous-* files: the state before the last one
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np

from evercal.bounds import bounds
from evercal.errors import InputError
from evercal.features.encoder import Encoder, Features, load_encoder
from evercal.geometry import Camera, pose_to_dict
from evercal.mapping.consistency import (
    of_evercal,
    require_consistent,
    require_landmarks,
    require_of_encoder,
)
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.map_frame import (
    correction_of,
    correction_tensors,
    frame_of,
    frame_to_dict,
    stored_pose,
)
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.recordings.frame import checked_name
from evercal.robot.frame_names import FrameNames
from evercal.storage.atomic import write_json
from evercal.storage.manifest import Manifest
from evercal.storage.stages import (
    REPORT,
    STAGES,
    StageStore,
    is_store,
    read_report,
    read_store,
    require_free,
    write_report,
)
from evercal.storage.tensors import load_tensors, open_tensors, save_tensors
from evercal.storage.text_files import named_errors, refuse_repeated
from evercal.typing import JsonObject, Record

KIND = "map"
"""Kind of store in its manifest."""
STRATEGY = "evercal"
"""Name of maps among the strategies of `evercal learn`."""
SCENE = "scene.json"
KEYFRAMES = "keyframes.safetensors"
CORRECTION = "correction.safetensors"
REFRESHES = "refreshes.json"
_STATE = (SCENE, KEYFRAMES, CORRECTION)
"""Files that a refresh replaces."""
PREVIOUS = "previous-"
"""Prefix of their state before the last refresh."""
_FILES = (*_STATE, REPORT, REFRESHES, *(PREVIOUS + name for name in _STATE))
"""Files of a scene."""


class MapStore(StageStore[MapContents]):
    """A map on disk and in memory.

    The networks are the files of the encoder and, if it is not shipped, of its centroids.
    """

    @classmethod
    def open(cls, root: Path, encoder: Features | Encoder | None = None) -> Self:
        """Open a map at its last complete scene.

        For a store that was made with a function of the caller's own, `encoder` is that function.
        """

        def read(manifest: Manifest) -> Self:
            payload = require_map(root, manifest)
            first, *centroids = (str(name) for name in payload["networks"])
            path = root / first
            local = load_encoder(encoder, path)
            for name in centroids:
                stored = load_tensors(root / name)["centroids"]
                local.centroids = stored.astype(np.float32)
            contents = MapContents(local, int(payload["short_side"]))
            stages = [str(name) for name in payload["stages"]]
            store = cls(root, contents, stages, (first, *centroids))
            contents.scenes = read_scenes(root, manifest)
            for name, scene in zip(stages, contents.scenes, strict=True):
                with of_evercal(store.folder(name)):
                    require_of_encoder(scene, local, contents.short_side)
            return store

        return read_store(root, read)

    @classmethod
    def create(
        cls,
        root: Path,
        encoder: Path | Features | Encoder | None = None,
        short_side: int = 240,
    ) -> Self:
        """An empty map; nothing is written before the first `commit`.

        `root` must not exist or be empty. The encoder is as for `load_encoder`.
        """
        require_free(root)
        return cls(root, MapContents(load_encoder(encoder), short_side))

    @classmethod
    def open_or_create(cls, root: Path, encoder: Path | Features | None = None) -> Self:
        """The map at a path, or a new one."""
        if not is_store(root):
            return cls.create(root, encoder)
        if isinstance(encoder, Path):
            raise InputError(
                f"encoder {encoder}: store {root} keeps the encoder it was made with"
            )
        return cls.open(root, encoder)

    def commit(
        self, scene: SceneMap, report: Record, replaced: str | None = None
    ) -> None:
        """Add a scene, in the place of one that is removed or of none: whole, or not at all."""
        names = self.contents.names
        if scene.name != replaced and scene.name in names:
            raise InputError(
                f"scene {scene.name!r}: map {self.root} has a scene of this name"
            )

        def write(folder: Path) -> None:
            if not self.networks:
                self.networks = self.contents.encoder.write(self.root)
            write_scene(folder, scene)
            save_tensors(folder / KEYFRAMES, scene.keyframes.to_tensors())
            write_report(folder, report)

        kept = [
            stage
            for stage, name in zip(self.stages, names, strict=True)
            if name != replaced
        ]
        self.change(kept, [(scene.name, write)], self.payload)
        # A localizer that still answers keeps the contents it was made with.
        self.contents = self.contents.without(replaced).with_scene(scene)

    def update(self, scene: SceneMap) -> None:
        """Replace what is stored of a scene beside its keyframes: whole, or not at all.

        It replaces the scene of the same name. The state before a refresh was in another base
        frame, so it is dropped, and `undo` refuses.
        """

        def write(folder: Path) -> None:
            write_scene(folder, scene)
            for part in _STATE:
                (folder / f"{PREVIOUS}{part}").unlink(missing_ok=True)

        self._exchange(scene, write)

    def refresh(self, scene: SceneMap, report: Record) -> None:
        """Replace a scene of the same name by its refreshed map: whole, or not at all.

        The state before is kept for `undo`.
        """

        def write(folder: Path) -> None:
            for name in _STATE:
                _move(folder / name, folder / f"{PREVIOUS}{name}")
            write_scene(folder, scene)
            save_tensors(folder / KEYFRAMES, scene.keyframes.to_tensors())
            write_json(
                folder / REFRESHES, {"refreshes": [*refreshes(folder), dict(report)]}
            )

        self._exchange(scene, write)

    def undo(self, name: str) -> None:
        """Bring back the state of a scene before its last refresh: whole, or not at all."""
        names = self.contents.names
        if name not in names:
            raise InputError(
                f"scene {name!r}: store {self.root} has {', '.join(names) or 'none'}"
            )
        index = names.index(name)
        before = self.folder(self.stages[index])
        if not (before / f"{PREVIOUS}{SCENE}").exists():
            raise InputError(f"scene {name!r}: no refresh to undo")

        def write(folder: Path) -> None:
            for part in _STATE:
                (folder / part).unlink(missing_ok=True)
                _move(folder / f"{PREVIOUS}{part}", folder / part)
            write_json(folder / REFRESHES, {"refreshes": refreshes(folder)[:-1]})

        self.replace(index, write, self.payload)
        scene = read_scene(self.folder(self.stages[index]))
        self.contents = self.contents.with_replaced(index, scene)

    def _exchange(self, scene: SceneMap, write: Callable[[Path], None]) -> None:
        index = self.contents.names.index(scene.name)
        self.replace(index, write, self.payload)
        self.contents = self.contents.with_replaced(index, scene)

    @property
    def payload(self) -> JsonObject:
        """Settings in the manifest."""
        return {
            "kind": KIND,
            "strategy": STRATEGY,
            "short_side": self.contents.short_side,
        }


def stored_scenes(root: Path) -> dict[str, JsonObject]:
    """Reports of the scenes of a map by name; the encoder is not read."""

    def read(manifest: Manifest) -> dict[str, JsonObject]:
        stored = {}
        scenes = read_scenes(root, manifest)
        for scene, stage in zip(scenes, manifest.payload["stages"], strict=True):
            stored[scene.name] = read_report(root / STAGES / stage)
        return stored

    return read_store(root, read)


def require_map(root: Path, manifest: Manifest) -> JsonObject:
    """The payload of a map's manifest."""
    payload = manifest.payload
    if payload.get("kind") != KIND:
        raise InputError(
            f"store {root}: holds networks of strategy {payload.get('strategy')!r}, not a map"
        )
    short_side = payload.get("short_side")
    if not isinstance(short_side, int) or not 16 <= short_side <= bounds().map_side:
        raise InputError(
            f"store {root}: 'short_side' in the manifest is {short_side!r}; restore it"
        )
    if not payload["networks"]:
        raise InputError(f"store {root}: the manifest lists no encoder; restore it")
    known = set(payload["networks"])
    for stage in payload["stages"]:
        known.update(f"{STAGES}/{stage}/{name}" for name in _FILES)
    if others := sorted(manifest.files.keys() - known):
        raise InputError(
            f"store {root}: {others[0]} in the manifest is no file of a map; restore it"
        )
    return payload


def write_scene(folder: Path, scene: SceneMap) -> None:
    """Write everything of a scene but its keyframes into its folder."""
    with named_errors(f"scene {scene.name!r}", "map"):
        require_consistent(scene)
    content = {
        "name": scene.name,
        "camera": scene.camera.to_dict(),
        "adjusted_camera": scene.adjusted_camera.to_dict(),
        "train_frames": scene.train_frames,
        "metric": scene.unit is None,
        "parent_frame": scene.parent_frame,
        "frames": vars(scene.frames),
        "unit": scene.unit or 1.0,
        "intrinsics_sigma": list(scene.intrinsics_sigma),
        "base": scene.base,
        "places": {place: pose_to_dict(pose) for place, pose in scene.places.items()},
        "frame": frame_to_dict(scene.frame),
    }
    write_json(folder / SCENE, content)
    # That of the scene that is replaced.
    (folder / CORRECTION).unlink(missing_ok=True)
    if scene.frame.correction:
        save_tensors(folder / CORRECTION, correction_tensors(scene.frame.correction))


def refreshes(folder: Path) -> list[JsonObject]:
    """Reports of the refreshes of a scene, oldest first."""
    file = folder / REFRESHES
    return json.loads(file.read_bytes())["refreshes"] if file.exists() else []


def _move(source: Path, target: Path) -> None:
    target.unlink(missing_ok=True)
    if source.exists():
        source.rename(target)


def read_scenes(root: Path, manifest: Manifest) -> list[SceneMap]:
    """The scenes that a manifest lists; two of one name are refused."""
    stages = require_map(root, manifest)["stages"]
    scenes = [read_scene(root / STAGES / name) for name in stages]
    names = [scene.name for scene in scenes]
    with named_errors(f"store {root}", "map"):
        refuse_repeated(names, "learn its scenes again into a new map, or restore it")
    return scenes


def read_scene(folder: Path) -> SceneMap:
    """Read a scene from its folder, and check that its parts agree."""
    with of_evercal(folder):
        scene = _read_scene(folder)
        require_consistent(scene)
        return scene


def _read_scene(folder: Path) -> SceneMap:
    content = json.loads((folder / SCENE).read_bytes())
    correction = None
    if (folder / CORRECTION).exists():
        correction = correction_of(load_tensors(folder / CORRECTION))
    unit = None
    # Maps written by earlier versions lack some keys.
    if not content.get("metric", True):
        unit = content.get("unit", 1.0)
    focal, centre, distortion = content.get("intrinsics_sigma", (0, 0, 0))
    arrays = open_tensors(folder / KEYFRAMES)
    keyframes = Keyframes.from_tensors(arrays)
    require_landmarks(arrays, keyframes.cameras)
    scene = SceneMap(
        name=checked_name(content["name"]),
        camera=Camera.from_dict(content["camera"]),
        adjusted_camera=Camera.from_dict(content["adjusted_camera"]),
        keyframes=keyframes,
        frame=frame_of(content["frame"], correction),
        train_frames=content["train_frames"],
        intrinsics_sigma=(float(focal), float(centre), float(distortion)),
        parent_frame=content.get("parent_frame", "base"),
        frames=FrameNames.from_dict(content.get("frames", {})),
        unit=unit,
        base=str(content.get("base", "")),
        places={
            place: stored_pose(pose)
            for place, pose in content.get("places", {}).items()
        },
    )
    if not scene.places:
        return replace(scene, places=scene.own_place)
    return scene
