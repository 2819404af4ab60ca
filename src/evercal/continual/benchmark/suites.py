"""Suites: named sequences of scenes for comparing strategies."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np

from evercal.classes import frozen
from evercal.continual.benchmark.sfm_poses import with_sfm_poses
from evercal.errors import InputError
from evercal.recordings import (
    MIN_TRAIN_FRAMES,
    Frame,
    Recording,
    load_recording,
    posed_frames,
    stated_poses,
)
from evercal.recordings.samples import sample_rooms
from evercal.typing import Array, Strings


@frozen
class Suite:
    """A named sequence of scenes."""

    scenes: Strings
    """Names in order of learning; each is a folder of the data."""
    source: str
    """Where the recordings are from."""


_THREE = ("bedroom", "kitchen", "living")
"""Kinds of rendered rooms."""
_TWELVE = (
    "bedroom-1",
    "kitchen-1",
    "living-1",
    "bedroom-2",
    "kitchen-2",
    "living-2",
    "bedroom-3",
    "kitchen-3",
    "living-3",
    "bedroom-4",
    "kitchen-4",
    "living-4",
)
"""Four rooms of each kind."""


def _rendered(name: str, scenes: Strings = _THREE) -> Suite:
    return Suite(scenes, f"python -m rooms {name} --out DIR")


SUITES: dict[str, Suite] = {
    "sim-mini": Suite(_THREE, "the package"),
    "sim": _rendered("sim"),
    "sim-7": _rendered("sim-7", _TWELVE[:7]),
    "sim-12": _rendered("sim-12", _TWELVE),
    "sim-repeat": _rendered("sim-repeat", ("workshop", "canteen", "hall")),
    "sim-tune": _rendered("sim-tune"),
    "sim-unseen": _rendered("sim-unseen"),
    "real2": Suite(
        ("redkitchen", "fr1_rpy"),
        "7-Scenes (Shotton et al., CVPR 2013) and TUM RGB-D (Sturm et al., IROS 2012)",
    ),
    "i7s": Suite(
        ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs"),
        "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/",
    ),
    "i12s": Suite(
        (
            "apt1/kitchen",
            "apt1/living",
            "apt2/bed",
            "apt2/kitchen",
            "apt2/living",
            "apt2/luke",
            "office1/gates362",
            "office1/gates381",
            "office1/lounge",
            "office1/manolis",
            "office2/5a",
            "office2/5b",
        ),
        "https://graphics.stanford.edu/projects/reloc/",
    ),
}


def load_suite(
    name: str,
    data: Path | None = None,
    scenes: Sequence[str] = (),
    poses: Path | None = None,
) -> list[Recording]:
    """Load the scenes of a suite in order of learning, by default all.

    `data` has a folder for each scene. `poses` are from structure from motion (Brachmann et al.,
    ICCV 2021), for i7s and i12s; by default they are the original ones.
    """
    if name not in SUITES:
        names = ", ".join([*SUITES, "custom", "regions"])
        raise InputError(f"suite {name!r}: unknown; choose one of {names}")
    if poses and name not in ("i7s", "i12s"):
        raise InputError(f"suite {name}: `poses` are for i7s and i12s")
    suite = SUITES[name]
    for scene in scenes:
        if scene not in suite.scenes:
            raise InputError(
                f"scene {scene!r}: not in suite {name}; choose from {', '.join(suite.scenes)}"
            )
    names = [scene for scene in suite.scenes if not scenes or scene in scenes]
    if name == "sim-mini":
        rooms = {room.scene.name: room.scene for room in sample_rooms()}
        return [rooms[scene] for scene in names]
    if not data:
        raise InputError("this suite needs recordings: give their folder with `data`")
    for scene in names:
        if not (data / scene).is_dir():
            raise InputError(
                f"suite {name}: {data / scene} is missing; get it from {suite.source}, or select"
                " other scenes with `scenes`"
            )
    recordings = []
    for scene in names:
        # Names of scenes have no slashes: apt1/kitchen becomes apt1-kitchen.
        recording = load_recording(data / scene, name=scene.replace("/", "-"))
        if poses:
            recording = with_sfm_poses(recording, poses, scene.replace("/", "_"))
        recordings.append(recording)
    return recordings


def tuning_split(scene: Recording) -> Recording:
    """Split training frames for choosing settings; the test frames are not used.

    Of ten equal runs of training frames, the third and the eighth become test frames.
    """
    frames = posed_frames(scene.train)
    tenth = 10 * np.arange(len(frames)) // len(frames)
    is_test = np.isin(tenth, (2, 7))
    train = tuple(compress(frames, ~is_test))
    test = tuple(compress(frames, is_test))
    if len(train) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"{scene.name}: {len(train)} of {len(frames)} training frames remain to learn; at least"
            f" {MIN_TRAIN_FRAMES} are needed; omit `held_out`"
        )
    return replace(scene, train=train, test=test)


def regions(scene: Recording, parts: int) -> list[Recording]:
    """Split a scene into a sequence of regions (Bahadir et al., Mach. Vis. Appl. 2024).

    Regions are k-means clusters of the points one metre in front of the training cameras, in the
    order in which the recording first reaches them. Test frames belong to the nearest cluster. All
    regions share one base frame, so a pose in a neighbouring region counts.
    """
    from scipy.cluster.vq import kmeans2, vq

    if parts < 2:
        raise InputError(f"`parts` {parts}: give at least 2")
    train = posed_frames(scene.train)
    test = posed_frames(scene.test)
    if len(train) < parts or not test:
        raise InputError(
            f"{scene.name}: {len(train)} training and {len(test)} test frames are too few for"
            f" `parts` {parts}"
        )
    rng = np.random.default_rng(0)
    centres, train_region = kmeans2(_ahead(train), parts, minit="++", rng=rng)
    test_region, _ = vq(_ahead(test), centres)
    recordings = []
    for number, region in enumerate(dict.fromkeys(train_region.tolist()), start=1):
        region_train = tuple(compress(train, train_region == region))
        region_test = tuple(compress(test, test_region == region))
        name = f"{scene.name}-{number}"
        if len(region_train) < MIN_TRAIN_FRAMES or not region_test:
            raise InputError(
                f"{name}: {len(region_train)} training and {len(region_test)} test frames are too"
                f" few (at least {MIN_TRAIN_FRAMES} and 1); give fewer `parts`"
            )
        recordings.append(
            replace(
                scene,
                name=name,
                train=region_train,
                test=region_test,
                base=scene.name,
            )
        )
    return recordings


def _ahead(frames: Sequence[Frame]) -> Array:
    poses = stated_poses(frames)
    return poses.translation_m + poses.rotation_matrix()[:, :, 2]
