"""Suites of scenes, and the splits of their frames."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from evercal.continual.benchmark.suites import SUITES, load_suite, tuning_split
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording

CAMERA = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)


def test_suites_load_their_scenes_in_order() -> None:
    assert [scene.name for scene in load_suite("sim-mini")] == [
        "bedroom",
        "kitchen",
        "living",
    ]
    some = load_suite("sim-mini", None, ["living", "bedroom"])
    assert [scene.name for scene in some] == ["bedroom", "living"]
    sizes = [
        len(SUITES[name].scenes)
        for name in ("sim-7", "sim-12", "sim-repeat", "i7s", "i12s")
    ]
    assert sizes == [7, 12, 3, 7, 12]


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (
            lambda _: load_suite("nonsense"),
            "suite 'nonsense': unknown; choose one of sim-mini",
        ),
        (
            lambda _: load_suite("sim-mini", None, ["attic"]),
            "scene 'attic': not in suite sim-mini",
        ),
        (lambda _: load_suite("real2"), "`data`"),
        (
            lambda data: load_suite("i7s", data),
            "chess is missing; get it from https://www.micro",
        ),
        (
            lambda data: load_suite("sim-mini", poses=str(data)),
            "`poses`: not used by recordings of format generic, only by 7scenes, 12scenes",
        ),
        (
            lambda data: load_suite("sim", data),
            "bedroom is missing; get it from python -m rooms",
        ),
    ],
)
def test_unavailable_suites_are_refused(
    load: Callable[[Path], object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        load(tmp_path)


def frame(name: str, x: float | None = 0.0) -> Frame:
    """A tiny frame at x, without a pose if x is None."""
    pose = None if x is None else SE3(np.array([1.0, 0, 0, 0]), np.array([x, 0, 0]))
    return Frame(name, np.zeros((3, 4, 3), np.uint8), CAMERA, pose)


def test_tuning_split_uses_training_frames_only() -> None:
    train = (frame("-1", None), *(frame(str(i)) for i in range(30)))
    scene = tuning_split(Recording("hall", train, (frame("99"),)))
    test = [6, 7, 8, 21, 22, 23]
    assert [int(f.name) for f in scene.test] == test
    assert [int(f.name) for f in scene.train] == [i for i in range(30) if i not in test]
    with pytest.raises(InputError, match=r"hall: 6 of 8 .* omit `held_out`"):
        tuning_split(Recording("hall", train[:9], ()))
