"""Suites: named sequences of scenes that methods are compared on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from evercal.datasets import Scene, load_scene
from evercal.errors import InputError
from evercal.simulation.cell import SUITES as ROOMS
from evercal.simulation.mini import mini_rooms


@dataclass(frozen=True)
class Suite:
    """What one name stands for."""

    scenes: tuple[str, ...]
    """Names in order of learning, each a folder of the data."""
    source: str
    """Where the data come from, for who has none."""
    load: Callable[[Path | None, Sequence[str]], list[Scene]]
    """(folder of the data, names) -> scenes."""


def _folders(data: Path | None, names: Sequence[str]) -> list[Scene]:
    if data is None:
        raise InputError("this suite needs its recordings: give their folder with --data")
    # A scene's name is a word: apt1/kitchen becomes apt1-kitchen.
    return [load_scene(data / name, name=name.replace("/", "-")) for name in names]


def _packaged(data: Path | None, names: Sequence[str]) -> list[Scene]:
    rooms = {room.scene.name: room.scene for room in mini_rooms()}
    return [rooms[name] for name in names]


def _rendered(name: str) -> Suite:
    rooms = tuple(room for room, _, _ in ROOMS[name].rooms)
    return Suite(rooms, f"evercal simulate {name} --out DIR", _folders)


SUITES: dict[str, Suite] = {
    "sim-mini": Suite(("bedroom", "kitchen", "living"), "the package", _packaged),
    "sim": _rendered("sim"),
    "sim-7": _rendered("sim-7"),
    "sim-12": _rendered("sim-12"),
    "real2": Suite(
        ("redkitchen", "fr1_rpy"),
        "7-Scenes (Shotton et al., CVPR 2013) and TUM RGB-D (Sturm et al., IROS 2012)",
        _folders,
    ),
    "i7s": Suite(
        ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs"),
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
        _folders,
    ),
    "i12s": Suite(
        (
            *(f"apt1/{room}" for room in ("kitchen", "living")),
            *(f"apt2/{room}" for room in ("bed", "kitchen", "living", "luke")),
            *(f"office1/{room}" for room in ("gates362", "gates381", "lounge", "manolis")),
            *(f"office2/{room}" for room in ("5a", "5b")),
        ),
        "https://graphics.stanford.edu/projects/reloc/",
        _folders,
    ),
}


def load_suite(name: str, data: Path | None = None, only: Sequence[str] = ()) -> list[Scene]:
    """The scenes of a suite in order of learning.

    Args:
        name: key of `SUITES`.
        data: folder that holds a folder for each scene; not for `sim-mini`.
        only: names of scenes to take, in the suite's order; all when empty.

    Raises:
        InputError: unknown suite or scene; a scene whose folder is missing, with where to get it.
    """
    if name not in SUITES:
        raise InputError(f"suite {name!r}: unknown; choose one of {', '.join(SUITES)}")
    suite = SUITES[name]
    unknown = [scene for scene in only if scene not in suite.scenes]
    if unknown:
        raise InputError(
            f"scene {unknown[0]!r}: not in suite {name}; choose from {', '.join(suite.scenes)}"
        )
    names = [scene for scene in suite.scenes if not only or scene in only]
    if data is not None and suite.load is _folders:
        missing = [scene for scene in names if not (data / scene).is_dir()]
        if missing:
            raise InputError(
                f"suite {name}: {data / missing[0]} is missing; get it from {suite.source}, or "
                f"leave it out with --scenes"
            )
    return suite.load(data, names)
