"""Suites: named sequences of scenes for comparing strategies."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.recordings import (
    MIN_TRAIN_FRAMES,
    ReadOptions,
    Recording,
    load_recording,
    posed_frames,
)
from evercal.recordings.load import naming_archives
from evercal.recordings.samples import FOLDER
from evercal.typing import Strings


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
    poses: str = "original",
) -> list[Recording]:
    """Load the scenes of a suite in order of learning, by default all.

    `data` has a folder for each scene. `poses` of i7s and i12s are those of `ReadOptions.poses`.
    """
    if name not in SUITES:
        names = ", ".join([*SUITES, "custom"])
        raise InputError(f"suite {name!r}: unknown; choose one of {names}")
    suite = SUITES[name]
    for scene in scenes:
        if scene not in suite.scenes:
            raise InputError(
                f"scene {scene!r}: not in suite {name}; choose from {', '.join(suite.scenes)}"
            )
    names = [scene for scene in suite.scenes if not scenes or scene in scenes]
    if name == "sim-mini":
        data = FOLDER
    if not data:
        raise InputError("this suite needs recordings: give their folder with `data`")
    for scene in names:
        if not (data / scene).is_dir():
            with naming_archives(data / scene):
                raise InputError(
                    f"suite {name}: {data / scene} is missing; {_remedy(data, scene, suite)}"
                )
    options = ReadOptions(poses=poses)
    recordings = []
    for scene in names:
        # Names of scenes have no slashes: apt1/kitchen becomes apt1-kitchen.
        place = scene.replace("/", "-")
        recording = load_recording(data / scene, name=place, options=options)
        recordings.append(recording)
    return recordings


def _remedy(data: Path, scene: str, suite: Suite) -> str:
    for folder in (data.resolve().parent, *sorted(data.glob("*"))):
        if (folder / scene).is_dir():
            return f"give `data` {folder}"
    return f"get it from {suite.source}, or select other scenes with `scenes`"


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
