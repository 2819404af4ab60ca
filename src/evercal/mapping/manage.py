"""Scenes of maps on disk: removed, renamed, merged, packed into one file and unpacked.

Every change is one step on disk, as when a scene is learned: after a crash the map opens at its
last complete state.
"""

import hashlib
import shutil
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import get_args

from evercal.bounds import bounds
from evercal.choices import OnClash
from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError
from evercal.features.encoder import read_network
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.mapping.store import (
    PREVIOUS,
    SCENE,
    MapStore,
    read_scenes,
    require_map,
    write_scene,
)
from evercal.recordings.frame import checked_name
from evercal.storage.archive import (
    check_archive,
    extract_archive,
    read_entry,
    write_archive,
)
from evercal.storage.atomic import replace_folder, write_bytes, write_json
from evercal.storage.manifest import MANIFEST, Manifest
from evercal.storage.stages import (
    REPORT,
    STAGES,
    StageStore,
    is_store,
    read_report,
    read_store,
)
from evercal.storage.text_files import read_json
from evercal.typing import PathLike, Strings


@frozen
class Merged:
    """Outcome of a merge: names of scenes in the map that was merged into."""

    added: Strings
    """New scenes, in order."""
    renamed: tuple[tuple[str, str], ...]
    """Name in the other map and new name of each scene whose name was taken."""
    skipped: Strings
    """Scenes that were left out because their names were taken."""
    replaced: Strings
    """Scenes that gave way to one of the same name."""


@frozen_arrays
class _Incoming:
    """A scene of another map."""

    root: Path
    stage: str
    manifest: Manifest
    scene: SceneMap


@frozen_arrays
class _Merge:
    """Scenes of a map while others are added."""

    on_clash: OnClash
    kept: dict[str, int]
    """Indices of scenes of the map, by name."""
    incoming: dict[str, _Incoming] = field(default_factory=dict)
    """New scenes by name."""
    renamed: list[tuple[str, str]] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    replaced: list[str] = field(default_factory=list)

    def add(self, item: _Incoming) -> None:
        """Add a scene of another map."""
        name = item.scene.name
        if name in self.kept or name in self.incoming:
            if self.on_clash == "refuse":
                raise InputError(
                    f"scene {name!r} of map {item.root}: the name is taken; rename it, or choose"
                    " with `on_clash` rename, skip or replace"
                )
            if self.on_clash == "skip":
                self.skipped.append(name)
                return
            if self.on_clash == "replace":
                self.replaced.append(name)
                self.kept.pop(name, None)
                self.incoming.pop(name, None)
            else:
                name = _free_name(name, {*self.kept, *self.incoming})
                self.renamed.append((item.scene.name, name))
        self.incoming[name] = item


def remove_scenes(store: MapStore, names: Sequence[str]) -> None:
    """Remove scenes from a map, all in one step."""
    if not names:
        raise InputError("no scene given; name one or more to remove")
    removed = {_index(store, name) for name in names}
    left = [i for i in range(len(store.stages)) if i not in removed]
    scenes = store.contents.scenes
    store.change([store.stages[i] for i in left], [], store.payload)
    # A localizer that still answers keeps the contents it was made with.
    store.contents = replace(store.contents, scenes=[scenes[i] for i in left])


def rename_scene(
    store: MapStore,
    name: str,
    new: str,
) -> None:
    """Give a scene another name."""
    index = _index(store, name)
    if checked_name(new) in store.contents.names:
        raise InputError(
            f"scene {new!r}: map {store.root} has a scene of this name; give another"
        )
    store.replace(index, lambda folder: _write_name(folder, new), store.payload)
    renamed = replace(store.contents.scenes[index], name=new)
    store.contents = store.contents.with_replaced(index, renamed)


def merge_maps(
    store: MapStore,
    others: Sequence[PathLike],
    on_clash: OnClash = "refuse",
    place: Callable[[SceneMap, MapContents], SceneMap] = lambda scene, _: scene,
) -> Merged:
    """Add the scenes of other maps to a map, all in one step.

    A new map takes the encoder of the first one. A map that learned all scenes in turn gives the
    same answers.

    Args:
        store: The map that grows.
        others: Folders of the other maps; they do not change.
        on_clash: For names that are taken: `refuse`; `rename` to NAME-2; `skip` the new scene;
            `replace` the scene of the map.
        place: Relates a new scene to those before it.
    """
    if on_clash not in get_args(OnClash):
        raise InputError(
            f"on_clash {on_clash!r}: use one of {', '.join(get_args(OnClash))}"
        )
    if not others:
        raise InputError("no map given; name one or more to merge")
    roots = [Path(other) for other in others]
    maps = [_incoming(root) for root in roots]
    contents = store.contents
    networks = None
    if is_store(store.root):
        first = Manifest.read(store.root)
        reference = store.root
    else:
        contents = MapStore.open(roots[0]).contents.empty()
        first, _ = maps[0]
        reference = roots[0]
        networks = first
    kept = {name: i for i, name in enumerate(store.contents.names)}
    merge = _Merge(on_clash, kept)
    for root, (manifest, scenes) in zip(roots, maps, strict=True):
        if root.resolve() == store.root.resolve():
            raise InputError(
                f"map {root}: is the map that scenes are merged into; give others"
            )
        _require_same_networks(first, manifest, reference, root)
        for item in scenes:
            merge.add(item)
    if merge.incoming:
        _commit(store, merge, contents, networks, roots[0], place)
    return Merged(
        tuple(merge.incoming),
        tuple(merge.renamed),
        tuple(merge.skipped),
        tuple(merge.replaced),
    )


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


def unpack_map(file: Path, folder: Path) -> None:
    """Extract a map that `pack_map` has written: whole, or not at all.

    The archive is not trusted. Its manifest is read first, and must list its files with their
    sizes. Then paths, links, checksums and schema are checked, and every scene is read, before the
    folder appears.
    """
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(f"{folder}: exists; give a new folder")
    if not file.is_file():
        raise InputError(f"{file}: no such file; give an archive of 'evercal map pack'")
    sizes = check_archive(file)
    if sizes.pop(MANIFEST, None) is None:
        raise InputError(
            f"{file}: no {MANIFEST} in it; give an archive of 'evercal map pack'"
        )
    content = read_entry(file, MANIFEST, bounds().manifest_bytes)
    _require_listed(sizes, Manifest.of(content, file), file)
    resolved = folder.resolve()
    temporary = resolved.with_name(f".{resolved.name}.unpacking")
    with StageStore(folder, None).writing():
        # Left by a process that was killed.
        shutil.rmtree(temporary, ignore_errors=True)
        try:
            extract_archive(file, temporary)
            _require_map_of(temporary, file)
            replace_folder(temporary, resolved)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _index(store: MapStore, name: str) -> int:
    names = store.contents.names
    if name not in names:
        known = "none"
        if names:
            known = ", ".join(names)
        raise InputError(
            f"scene {name!r}: map {store.root} has no scene of this name; it has {known}"
        )
    return names.index(name)


def _write_name(folder: Path, name: str) -> None:
    previous = f"{PREVIOUS}{SCENE}"
    for file, key in ((SCENE, "name"), (REPORT, "scene"), (previous, "name")):
        if file != previous or (folder / file).exists():
            content = read_json(folder / file, "part of a scene", "restore the map")
            write_json(folder / file, {**content, key: name})


def _free_name(name: str, taken: set[str]) -> str:
    number = 2
    while f"{name}-{number}" in taken:
        number += 1
    return f"{name}-{number}"


def _incoming(root: Path) -> tuple[Manifest, list[_Incoming]]:
    def read(manifest: Manifest) -> tuple[Manifest, list[_Incoming]]:
        scenes = []
        for scene, stage in zip(
            read_scenes(root, manifest), manifest.payload["stages"], strict=True
        ):
            scenes.append(_Incoming(root, stage, manifest, scene))
        return manifest, scenes

    return read_store(root, read)


def _require_same_networks(
    first: Manifest,
    other: Manifest,
    root: Path,
    path: Path,
) -> None:
    for key, meaning in (("short_side", "image size"), ("strategy", "strategy")):
        expected = first.payload.get(key)
        value = other.payload.get(key)
        if value != expected:
            raise InputError(
                f"map {path}: {meaning} {value}, map {root} has {expected}; learn its scenes again"
            )
    if _networks(root, first) != _networks(path, other):
        names = ", ".join(other.payload["networks"])
        raise InputError(
            f"map {path}: was made with another encoder or other centroids ({names}) than map"
            f" {root} ({', '.join(first.payload['networks'])}); learn its scenes into that map"
        )


def _networks(root: Path, manifest: Manifest) -> set[object]:
    """What identifies the networks of a map.

    Maps written by earlier versions store the first encoder in another format.
    """
    identities = set()
    for name in map(str, manifest.payload["networks"]):
        identity = read_network(root / name)[0]
        identities.add(identity or manifest.files[name]["sha256"])
    return identities


def _commit(
    store: MapStore,
    merge: _Merge,
    contents: MapContents,
    networks: Manifest | None,
    source: Path,
    place: Callable[[SceneMap, MapContents], SceneMap],
) -> None:
    """Write a merged map. A new one also gets the networks of the first map, `source`."""

    def copy(
        name: str,
        item: _Incoming,
        folder: Path,
    ) -> None:
        if networks:
            store.networks = tuple(networks.payload["networks"])
            for network in store.networks:
                _copy(source, network, networks, store.root / network)
        prefix = f"{STAGES}/{item.stage}/"
        for file in item.manifest.files:
            if file.startswith(prefix):
                target = folder / file.removeprefix(prefix)
                _copy(item.root, file, item.manifest, target)
        if name != item.scene.name:
            _write_name(folder, name)
        write_scene(folder, grown.scene(name))

    added = []
    kept = [contents.scenes[i] for i in merge.kept.values()]
    grown = replace(contents, scenes=kept)
    for name, item in merge.incoming.items():
        added.append((name, partial(copy, name, item)))
        scene = place(replace(item.scene, name=name), grown)
        grown = grown.with_scene(scene)
    stages = [store.stages[i] for i in merge.kept.values()]
    payload = {**store.payload, "short_side": contents.short_side}
    store.change(stages, added, payload)
    store.contents = grown


def _copy(
    root: Path,
    file: str,
    manifest: Manifest,
    target: Path,
) -> None:
    try:
        data = (root / file).read_bytes()
    except FileNotFoundError:
        data = b""
    if hashlib.sha256(data).hexdigest() != manifest.files[file]["sha256"]:
        raise InputError(f"map {root}: another process has changed it; run it again")
    write_bytes(target, data)


def _require_listed(sizes: dict[str, int], manifest: Manifest, file: Path) -> None:
    """Refuse an archive whose files are not those of its manifest."""
    listed = {name: record["bytes"] for name, record in manifest.files.items()}
    if differing := sizes.items() ^ listed.items():
        name, _ = min(differing)
        raise InputError(
            f"{file}: {name} has {sizes.get(name, 0)} bytes, expected"
            f" {listed.get(name, 0)}; its manifest does not list these files"
        )


def _require_map_of(root: Path, file: Path) -> None:
    try:
        manifest, _ = _incoming(root)
        for stage in manifest.payload["stages"]:
            read_report(root / STAGES / stage)
        # A function of the caller's own cannot be read here.
        if manifest.payload["networks"][0].endswith(".onnx"):
            MapStore.open(root)
    except InputError as error:
        raise InputError(
            f"{file}: {str(error).replace(str(root), file.name)}"
        ) from None
