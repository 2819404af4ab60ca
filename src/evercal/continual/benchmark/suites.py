"""Suites: named sequences of scenes that methods are compared on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.recordings import (
    MIN_TRAIN_FRAMES,
    Frame,
    Recording,
    load_recording,
    posed_frames,
    stated_poses,
    with_sfm_poses,
)
from evercal.recordings.samples import sample_rooms
from evercal.simulation.cell import SUITES as ROOMS


@dataclass(frozen=True)
class Suite:
    """What one name stands for."""

    scenes: tuple[str, ...]
    """Names in order of learning, each a folder of the data."""
    source: str
    """Where the data come from, for who has none."""
    load: Callable[[Path | None, Sequence[str]], list[Recording]]
    """(folder of the data, names) -> scenes."""


def _folders(data: Path | None, names: Sequence[str]) -> list[Recording]:
    if data is None:
        raise InputError("this suite needs its recordings: give their folder with --data")
    # A scene's name is a word: apt1/kitchen becomes apt1-kitchen.
    return [load_recording(data / name, name=name.replace("/", "-")) for name in names]


def _packaged(data: Path | None, names: Sequence[str]) -> list[Recording]:
    rooms = {room.scene.name: room.scene for room in sample_rooms()}
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


def load_suite(
    name: str, data: Path | None = None, only: Sequence[str] = (), poses: Path | None = None
) -> list[Recording]:
    """The scenes of a suite in order of learning.

    Args:
        name: key of `SUITES`.
        data: folder that holds a folder for each scene; not for `sim-mini`.
        only: names of scenes to take, in the suite's order; all when empty.
        poses: folder of structure-from-motion poses (`datasets.sfm_poses`) to take instead of those
            of i7s or i12s.

    Raises:
        InputError: unknown suite or scene; a scene whose folder is missing, with where to get it;
            poses for another suite.
    """
    if name not in SUITES:
        known = ", ".join([*SUITES, "custom", "regions"])
        raise InputError(f"suite {name!r}: unknown; choose one of {known}")
    if poses is not None and name not in ("i7s", "i12s"):
        raise InputError(f"suite {name}: --poses are for i7s and i12s")
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
    scenes = suite.load(data, names)
    if poses is None:
        return scenes
    called = [scene.replace("/", "_") for scene in names]
    return [with_sfm_poses(s, poses, n) for s, n in zip(scenes, called, strict=True)]


def tuning_split(scene: Recording) -> Recording:
    """The scene for choosing settings: its test frames are not looked at.

    Of ten equal runs of training frames the third and the eighth are judged, the others learned.

    Raises:
        InputError: fewer posed training frames than a scene needs after that.
    """
    frames = posed_frames(scene.train)
    tenth = [10 * i // len(frames) for i in range(len(frames))]
    learned = tuple(f for f, part in zip(frames, tenth, strict=True) if part not in (2, 7))
    judged = tuple(f for f, part in zip(frames, tenth, strict=True) if part in (2, 7))
    if len(learned) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"{scene.name}: {len(learned)} of {len(frames)} training frames are left to learn, "
            f"at least {MIN_TRAIN_FRAMES} are needed; leave out --held-out"
        )
    return replace(scene, train=learned, test=judged)


def regions(scene: Recording, parts: int) -> list[Recording]:
    """One scene as a sequence of its regions, after Bahadir et al. (Mach. Vis. Appl. 2024).

    Regions are k-means cells of the points a metre ahead of the training cameras, in the order in
    which the recording first comes to them; test frames go to the nearest. All share one base
    frame, so a pose found in a neighbouring region counts.

    Raises:
        InputError: fewer than two parts, or a region that is too small to learn or to judge.
    """
    from scipy.cluster.vq import kmeans2, vq

    if parts < 2:
        raise InputError(f"--parts {parts}: give at least 2")
    train, test = posed_frames(scene.train), posed_frames(scene.test)
    if len(train) < parts or not test:
        raise InputError(f"{scene.name}: {len(train)} training and {len(test)} test frames")
    centres, region = kmeans2(_ahead(train), parts, minit="++", rng=np.random.default_rng(0))
    nearest, _ = vq(_ahead(test), centres)
    found = []
    for number, part in enumerate(dict.fromkeys(region.tolist()), start=1):
        learned = tuple(f for f, r in zip(train, region, strict=True) if r == part)
        judged = tuple(f for f, r in zip(test, nearest, strict=True) if r == part)
        name = f"{scene.name}-{number}"
        if len(learned) < MIN_TRAIN_FRAMES or not judged:
            raise InputError(
                f"{name}: {len(learned)} training and {len(judged)} test frames are too few (at "
                f"least {MIN_TRAIN_FRAMES} and 1); give fewer --parts"
            )
        found.append(replace(scene, name=name, train=learned, test=judged, base=scene.name))
    return found


def _ahead(frames: Sequence[Frame]) -> np.ndarray:
    """(n, 3) points a metre ahead of the cameras."""
    poses = stated_poses(frames)
    return poses.translation_m + poses.rotation_matrix()[:, :, 2]
