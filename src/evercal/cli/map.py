"""`evercal map`: list, remove, rename, merge, pack and unpack."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from evercal.cli.console import require_writable, size
from evercal.cli.options import Store, Verb

if TYPE_CHECKING:
    from evercal.map import Map


@dataclass(frozen=True)
class List(Verb):
    """List the scenes of a map with their size.

    Example: evercal map list cell.evercal
    """

    store: Store

    def run(self) -> int:
        from evercal.mapping.store import MapStore

        scenes = [
            {
                "name": scene.name,
                "keyframes": len(scene.keyframes),
                "landmarks": scene.landmarks,
                "memory_bytes": scene.keyframes.bytes,
            }
            for scene in MapStore.open(self.store).contents.scenes
        ]
        lines = [
            f"{scene['name']}: {scene['keyframes']} keyframes,"
            f" {scene['landmarks']:,} landmarks, {size(scene['memory_bytes'])}"
            for scene in scenes
        ]
        record = {"store": str(self.store), "scenes": scenes}
        return self.answer(record, lines or [f"{self.store}: no scene"])


@dataclass(frozen=True)
class Remove(Verb):
    """Remove scenes from a map, all in one step.

    Example: evercal map remove cell.evercal kitchen
    """

    store: Store
    names: Annotated[Positional[tuple[str, ...]], arg(metavar="SCENE...", help_behavior_hint="")]
    """Scenes to remove."""

    def run(self) -> int:
        opened = _opened(self.store)
        opened.remove(*self.names)
        return _done(self, opened, f"removed {', '.join(self.names)}")


@dataclass(frozen=True)
class Rename(Verb):
    """Give a scene of a map another name.

    Example: evercal map rename cell.evercal kitchen kitchen-2025
    """

    store: Store
    name: Annotated[Positional[str], arg(metavar="SCENE")]
    """Name of the scene."""
    new: Annotated[Positional[str], arg(metavar="NEW")]
    """Its new name."""

    def run(self) -> int:
        opened = _opened(self.store)
        opened.rename(self.name, self.new)
        return _done(self, opened, f"renamed {self.name} to {self.new}")


@dataclass(frozen=True)
class Merge(Verb):
    """Add the scenes of other maps to a map, all in one step; a new folder becomes a new map.

    All maps must have one encoder and one image size.

    Example: evercal map merge all.evercal cell-1.evercal cell-2.evercal
    """

    store: Store
    """Folder of the map that grows."""
    others: Annotated[Positional[tuple[Path, ...]], arg(metavar="OTHER...", help_behavior_hint="")]
    """Folders of the other maps; they do not change."""
    on_clash: Literal["refuse", "rename", "skip", "replace"] = "refuse"
    """For a scene whose name is taken: refuse the merge, rename it to NAME-2, skip it, or replace
    the scene of the map."""

    def run(self) -> int:
        from evercal.map import Map

        opened = Map.open(self.store, device="cpu")
        merged = opened.merge(*self.others, on_clash=self.on_clash)
        words = [f"added {', '.join(merged.added) or 'no scene'}"]
        words += [f"{name} is now {new}" for name, new in merged.renamed]
        words += [f"skipped {name}" for name in merged.skipped]
        words += [f"replaced {name}" for name in merged.replaced]
        return _done(self, opened, "; ".join(words), dataclasses.asdict(merged))


@dataclass(frozen=True)
class Pack(Verb):
    """Write a map into one file, a zip archive with checksums.

    Example: evercal map pack cell.evercal cell.zip
    """

    store: Store
    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """Output file; an existing one is replaced."""

    def run(self) -> int:
        from evercal.mapping.manage import pack_map

        require_writable(self.file, "FILE")
        pack_map(self.store, self.file)
        count = self.file.stat().st_size
        return self.answer(
            {"file": str(self.file), "bytes": count},
            [f"wrote {self.file} ({size(count)})"],
            ("map", "unpack", self.file, "MAP"),
        )


@dataclass(frozen=True)
class Unpack(Verb):
    """Extract a map from a file of 'evercal map pack'; every file is checked.

    Example: evercal map unpack cell.zip cell.evercal
    """

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The archive."""
    store: Store
    """New folder for the map."""

    def run(self) -> int:
        from evercal.mapping.manage import unpack_map

        unpack_map(self.file, self.store)
        return _done(self, _opened(self.store), f"unpacked {self.file}")


@dataclass(frozen=True)
class Maps:
    """Manage the scenes of a map: list, remove, rename, merge, pack, unpack.

    Every change is one step: it happens completely or not at all. Every action has --json.

    Example: evercal map list cell.evercal
    """

    action: OmitSubcommandPrefixes[
        Annotated[List, subcommand("list")]
        | Annotated[Remove, subcommand("remove")]
        | Annotated[Rename, subcommand("rename")]
        | Annotated[Merge, subcommand("merge")]
        | Annotated[Pack, subcommand("pack")]
        | Annotated[Unpack, subcommand("unpack")]
    ]

    def run(self) -> int:
        return self.action.run()


def _opened(store: Path) -> "Map":
    from evercal.map import Map
    from evercal.storage import read_manifest

    read_manifest(store)
    return Map.open(store, device="cpu")


def _done(verb: Verb, opened: "Map", what: str, more: dict[str, object] | None = None) -> int:
    return verb.answer(
        {"store": str(opened.path), **(more or {}), "scenes": list(opened.scenes)},
        [f"{what}; scenes of {opened.path}: {', '.join(opened.scenes) or 'none'}"],
        ("map", "list", opened.path),
    )
