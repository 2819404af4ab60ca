"""Scenes of maps on disk: removed, renamed, merged, packed into one file and unpacked.

Every change is one step on disk, as when a scene is learned: after a crash the map opens at its
last complete state.
"""

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

from evercal.choices import OnClash
from evercal.errors import InputError
from evercal.features.encoder import read_network
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import PREVIOUS, SCENE, MapStore, read_scene, require_map
from evercal.recordings.frame import checked_name
from evercal.storage.archive import (
    ArchiveLimits,
    check_archive,
    extract_archive,
    write_archive,
)
from evercal.storage.atomic import replace_folder, write_bytes, write_json
from evercal.storage.manifest import MANIFEST, Manifest
from evercal.storage.stages import REPORT, STAGES, StageStore, is_store, read_store
from evercal.typing import PathLike


@dataclass(frozen=True)
class Merged:
    """Outcome of a merge: names of scenes in the map that was merged into."""

    added: tuple[str, ...]
    """New scenes, in order."""
    renamed: tuple[tuple[str, str], ...]
    """Name in the other map and new name of each scene whose name was taken."""
    skipped: tuple[str, ...]
    """Scenes that were left out because their names were taken."""
    replaced: tuple[str, ...]
    """Scenes that gave way to one of the same name."""


@dataclass(frozen=True, eq=False)
class _Incoming:
    """A scene of another map."""

    root: Path
    stage: str
    manifest: Manifest
    scene: SceneMap


def remove_scenes(store: MapStore, names: Sequence[str]) -> None:
    """Remove scenes from a map, all in one step."""
    if not names:
        raise InputError("no scene given; name one or more to remove")
    gone = {_index(store, name) for name in names}
    left = [i for i in range(len(store.stages)) if i not in gone]
    store.change([store.stages[i] for i in left], [], store.payload)
    # A localizer that still answers keeps the contents it was made with.
    store.contents = replace(
        store.contents, scenes=[store.contents.scenes[i] for i in left]
    )


def rename_scene(store: MapStore, name: str, new: str) -> None:
    """Give a scene another name."""
    index = _index(store, name)
    scenes = list(store.contents.scenes)
    if checked_name(new) in {scene.name for scene in scenes}:
        raise InputError(
            f"scene {new!r}: map {store.root} has a scene of this name; give another"
        )
    store.replace(index, lambda folder: _write_name(folder, new), store.payload)
    scenes[index] = replace(scenes[index], name=new)
    store.contents = replace(store.contents, scenes=scenes)


def merge_maps(
    store: MapStore,
    others: Sequence[PathLike],
    on_clash: OnClash = "refuse",
) -> Merged:
    """Add the scenes of other maps to a map, all in one step.

    A new map takes the encoder of the first one. Scenes are copied unchanged. Their thresholds were
    fitted in each scene alone, so a map that learned all scenes in turn gives the same answers.

    Args:
        store: The map that grows.
        others: Folders of the other maps; they do not change.
        on_clash: For names that are taken: `refuse`; `rename` to NAME-2; `skip` the new scene;
            `replace` the scene of the map.
    """
    if on_clash not in get_args(OnClash):
        raise InputError(
            f"on_clash {on_clash!r}: use one of {', '.join(get_args(OnClash))}"
        )
    if not others:
        raise InputError("no map given; name one or more to merge")
    is_new = not is_store(store.root)
    maps = [_incoming(Path(other)) for other in others]
    contents = store.contents
    if is_new:
        contents = MapStore.open(Path(others[0])).contents.empty()
    first = maps[0][0] if is_new else Manifest.read(store.root)
    networks = Path(others[0]) if is_new else store.root
    incoming: dict[str, _Incoming] = {}
    kept = {scene.name: i for i, scene in enumerate(store.contents.scenes)}
    renamed = []
    skipped = []
    replaced = []
    for other, (manifest, scenes) in zip(others, maps, strict=True):
        if Path(other).resolve() == store.root.resolve():
            raise InputError(
                f"map {other}: is the map that scenes are merged into; give others"
            )
        _require_same_networks(first, manifest, networks, Path(other))
        for item in scenes:
            name = item.scene.name
            if name in kept or name in incoming:
                if on_clash == "refuse":
                    raise InputError(
                        f"scene {name!r} of map {other}: the name is taken; rename it, or choose"
                        " with --on-clash rename, skip or replace"
                    )
                if on_clash == "skip":
                    skipped.append(name)
                    continue
                if on_clash == "replace":
                    replaced.append(name)
                    kept.pop(name, None)
                    incoming.pop(name, None)
                else:
                    name = _free_name(name, {*kept, *incoming})
                    renamed.append((item.scene.name, name))
            incoming[name] = item
    if incoming:
        networks = first if is_new else None
        _commit(
            store, list(kept.values()), incoming, contents, networks, Path(others[0])
        )
    return Merged(tuple(incoming), tuple(renamed), tuple(skipped), tuple(replaced))


def pack_map(root: Path, file: Path) -> None:
    """Write a map into one zip archive, with its manifest and checksums.

    Raises:
        InputError: Not a map, or a file of it is missing or was changed.
        OSError: The archive cannot be written.
    """

    def write(manifest: Manifest) -> None:
        require_map(root, manifest)
        write_archive(file, root, [MANIFEST, *manifest.files])
        # Read again: another process has changed the map.
        if Manifest.read(root) != manifest:
            raise InputError(
                f"store {root}: another process has changed it; run it again"
            )

    if file.resolve().is_relative_to(root.resolve()):
        raise InputError(f"{file}: lies inside the map; give a file elsewhere")
    read_store(root, write)


def unpack_map(file: Path, folder: Path, limits: ArchiveLimits | None = None) -> None:
    """Extract a map that `pack_map` has written: whole, or not at all.

    The archive is not trusted: paths, links, sizes, checksums and schema are checked, and every
    scene is read, before the folder appears.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: exists; give a new folder")
    if not file.is_file():
        raise InputError(f"{file}: no such file; give an archive of 'evercal map pack'")
    limits = limits or ArchiveLimits()
    names = check_archive(file, limits)
    if MANIFEST not in names:
        raise InputError(
            f"{file}: no {MANIFEST} in it; give an archive of 'evercal map pack'"
        )
    resolved = folder.resolve()
    temporary = resolved.with_name(f".{resolved.name}.unpacking")
    with StageStore(folder, None).writing():
        # Left by a process that was killed.
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            extract_archive(file, temporary, limits)
            _require_map_of(temporary, names, file)
            replace_folder(temporary, resolved)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _index(store: MapStore, name: str) -> int:
    names = [scene.name for scene in store.contents.scenes]
    if name not in names:
        has = f"it has {', '.join(names)}" if names else "it has none"
        raise InputError(
            f"scene {name!r}: map {store.root} has no scene of this name; {has}"
        )
    return names.index(name)


def _write_name(folder: Path, name: str) -> None:
    for file, key in (
        (SCENE, "name"),
        (REPORT, "scene"),
        (f"{PREVIOUS}{SCENE}", "name"),
    ):
        if file.startswith(PREVIOUS) and not (folder / file).exists():
            continue
        content = json.loads((folder / file).read_text(encoding="utf-8"))
        write_json(folder / file, {**content, key: name})


def _free_name(name: str, taken: set[str]) -> str:
    number = 2
    while f"{name}-{number}" in taken:
        number += 1
    return f"{name}-{number}"


def _incoming(root: Path) -> tuple[Manifest, list[_Incoming]]:
    def read(manifest: Manifest) -> tuple[Manifest, list[_Incoming]]:
        stages = [str(stage) for stage in require_map(root, manifest)["stages"]]
        return manifest, [
            _Incoming(root, stage, manifest, read_scene(root / STAGES / stage))
            for stage in stages
        ]

    return read_store(root, read)


def _require_same_networks(
    first: Manifest, other: Manifest, root: Path, path: Path
) -> None:
    for key, what in (("short_side", "image size"), ("strategy", "strategy")):
        a = first.payload.get(key)
        b = other.payload.get(key)
        if a != b:
            raise InputError(
                f"map {path}: {what} {b}, map {root} has {a}; learn its scenes again"
            )
    if _networks(root, first) != _networks(path, other):
        names = ", ".join(other.payload["networks"])
        raise InputError(
            f"map {path}: was made with another encoder or other centroids ({names}) than map"
            f" {root} ({', '.join(first.payload['networks'])}); learn its scenes into that map"
        )


def _networks(root: Path, manifest: Manifest) -> set[object]:
    """What identifies the networks of a map: maps of before store the first encoder otherwise."""
    names = [str(name) for name in manifest.payload["networks"]]
    return {
        read_network(root / name)[0] or manifest.files[name]["sha256"] for name in names
    }


def _commit(
    store: MapStore,
    kept: Sequence[int],
    incoming: dict[str, _Incoming],
    contents: MapContents,
    networks: Manifest | None,
    source: Path,
) -> None:
    """Write a merged map. A new one also gets the networks of the first map, `source`."""

    def copy(name: str, item: _Incoming, folder: Path) -> None:
        if networks is not None:
            store.networks = tuple(networks.payload["networks"])
            for network in store.networks:
                _copy(source, network, networks, store.root / network)
        prefix = f"{STAGES}/{item.stage}/"
        for file in item.manifest.files:
            if file.startswith(prefix):
                _copy(
                    item.root, file, item.manifest, folder / file.removeprefix(prefix)
                )
        if name != item.scene.name:
            _write_name(folder, name)

    added = [(name, partial(copy, name, item)) for name, item in incoming.items()]
    payload = {**store.payload, "short_side": contents.short_side}
    store.change([store.stages[i] for i in kept], added, payload)
    new = [replace(item.scene, name=name) for name, item in incoming.items()]
    scenes = [*(contents.scenes[i] for i in kept), *new]
    store.contents = replace(contents, scenes=scenes)


def _copy(root: Path, file: str, manifest: Manifest, target: Path) -> None:
    try:
        data = (root / file).read_bytes()
    except FileNotFoundError:
        data = b""
    if hashlib.sha256(data).hexdigest() != manifest.files[file]["sha256"]:
        raise InputError(f"map {root}: another process has changed it; run it again")
    write_bytes(target, data)


def _require_map_of(root: Path, names: Sequence[str], file: Path) -> None:
    try:
        listed = {MANIFEST, *Manifest.read(root).files}
        if extra := sorted(set(names) - listed):
            raise InputError(f"{root}: {extra[0]} is not in its manifest")
        _incoming(root)
    except InputError as error:
        raise InputError(
            f"{file}: {str(error).replace(str(root), file.name)}"
        ) from None
    except Exception as error:  # files with right checksums, written by another program
        raise InputError(
            f"{file}: is not a map that evercal wrote ({error!r})"
        ) from None
