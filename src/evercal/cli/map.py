"""`evercal map`: list, remove, rename, merge, pack and unpack."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from evercal.choices import OnClash
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import require_writable, size

if TYPE_CHECKING:
    from evercal.map import Map as LearnedMap

Archive = Annotated[Positional[Path], arg(metavar="FILE")]


@frozen
class Action(args.Verb):
    """An action on a map."""

    def opened(self, store: Path) -> "LearnedMap":
        """The map at a path that must exist."""
        from evercal.map import Map as LearnedMap
        from evercal.storage import read_manifest

        read_manifest(store)
        return LearnedMap.open(store)

    def done(self, cell: "LearnedMap", what: str, **more: object) -> int:
        """Say what was done and which scenes there are."""
        record = {"store": str(cell.path), **more, "scenes": list(cell.scenes)}
        line = f"{what}; scenes of {cell.path}: {', '.join(cell.scenes) or 'none'}"
        self.answer(record, line, then=("map", "list", cell.path))
        return 0


@frozen
class List(Action):
    """List the scenes of a map with their size.

    Example: evercal map list cell.evercal
    """

    store: args.Store

    def run(self) -> int:
        from evercal.mapping.store import MapStore

        scenes = []
        lines = []
        for scene in MapStore.open(self.store).contents.scenes:
            keyframes = len(scene.keyframes)
            memory = scene.keyframes.bytes
            scenes.append(
                {
                    "name": scene.name,
                    "base": scene.base,
                    "keyframes": keyframes,
                    "landmarks": scene.landmarks,
                    "memory_bytes": memory,
                }
            )
            counts = f"{keyframes} keyframes, {scene.landmarks:,} landmarks"
            base = f", base {scene.base}" if scene.base else ""
            lines.append(f"{scene.name}: {counts}, {size(memory)}{base}")
        if not lines:
            lines.append(f"{self.store}: no scene")
        self.answer({"store": str(self.store), "scenes": scenes}, *lines)
        return 0


@frozen
class Remove(Action):
    """Remove scenes from a map, all in one step.

    Example: evercal map remove cell.evercal kitchen
    """

    store: args.Store
    names: Annotated[Positional[tuple[str, ...]], args.shown("SCENE...")]
    """Scenes to remove."""

    def run(self) -> int:
        cell = self.opened(self.store)
        cell.remove(*self.names)
        return self.done(cell, f"removed {', '.join(self.names)}")


@frozen
class Rename(Action):
    """Give a scene of a map another name.

    Example: evercal map rename cell.evercal kitchen kitchen-2025
    """

    store: args.Store
    name: args.SceneName
    """Name of the scene."""
    new: Annotated[Positional[str], arg(metavar="NEW")]
    """Its new name."""

    def run(self) -> int:
        cell = self.opened(self.store)
        cell.rename(self.name, self.new)
        return self.done(cell, f"renamed {self.name} to {self.new}")


@frozen
class Merge(Action):
    """Add the scenes of other maps to a map, all in one step; a new folder becomes a new map.

    All maps must have one encoder and one image size.

    Example: evercal map merge all.evercal cell-1.evercal cell-2.evercal
    """

    store: args.Store
    others: Annotated[Positional[tuple[Path, ...]], args.shown("OTHER...")]
    """Folders of the other maps; they do not change."""
    on_clash: OnClash = "refuse"
    """For a scene whose name is taken: refuse the merge, rename it to NAME-2, skip it, or replace
    the scene of the map."""

    def run(self) -> int:
        from evercal.map import Map as LearnedMap

        cell = LearnedMap.open(self.store)
        merged = cell.merge(*self.others, on_clash=self.on_clash)
        words = [f"added {', '.join(merged.added) or 'no scene'}"]
        words += [f"{name} is now {new}" for name, new in merged.renamed]
        words += map("skipped {}".format, merged.skipped)
        words += map("replaced {}".format, merged.replaced)
        return self.done(cell, "; ".join(words), **dataclasses.asdict(merged))


@frozen
class Pack(Action):
    """Write a map into one file, a zip archive with checksums.

    Example: evercal map pack cell.evercal cell.zip
    """

    store: args.Store
    file: Archive
    """Output file; an existing one is replaced."""

    def run(self) -> int:
        from evercal.mapping.manage import pack_map

        require_writable(self.file, "FILE")
        pack_map(self.store, self.file)
        count = self.file.stat().st_size
        line = f"wrote {self.file} ({size(count)})"
        then = ("map", "unpack", self.file, "MAP")
        self.answer({"file": str(self.file), "bytes": count}, line, then=then)
        return 0


@frozen
class Unpack(Action):
    """Extract a map from a file of 'evercal map pack' into a new folder; every file is checked.

    Example: evercal map unpack cell.zip cell.evercal
    """

    file: Archive
    """The archive."""
    store: args.Store

    def run(self) -> int:
        from evercal.mapping.manage import unpack_map

        unpack_map(self.file, self.store)
        return self.done(self.opened(self.store), f"unpacked {self.file}")


@dataclass(frozen=True)
class Map:
    """Manage scenes of a map: list, remove, rename, merge, pack, unpack.

    Every change is one step: it happens completely or not at all. Every action has --json.

    Example: evercal map list cell.evercal
    """

    writes = ()
    """See `args.Verb`."""
    action: OmitSubcommandPrefixes[
        Annotated[List, subcommand("list")]
        | Annotated[Remove, subcommand("remove")]
        | Annotated[Rename, subcommand("rename")]
        | Annotated[Merge, subcommand("merge")]
        | Annotated[Pack, subcommand("pack")]
        | Annotated[Unpack, subcommand("unpack")]
    ]

    def set_limits(self) -> None:
        self.action.set_limits()

    def run(self) -> int:
        return self.action.run()
