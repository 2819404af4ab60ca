"""`benchmarks maps` on tiny rooms: rows and settings."""

import json
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import maps
from evercal.errors import InputError
from evercal.recordings import Recording, generic

pytestmark = pytest.mark.slow("benchmarks", "src/evercal/evaluation")


@pytest.fixture(scope="module")
def folders(
    arcs: tuple[Recording, Recording], tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    root = tmp_path_factory.mktemp("recorded")
    for arc in arcs:
        generic.write(root / arc.name, replace(arc, test=arc.test[::4]))
    return [root / arc.name for arc in arcs]


def test_sequence_reports_each_scene_and_their_mean(
    folders: list[Path], tmp_path: Path
) -> None:
    maps.run("sequence", tuple(folders), tmp_path, 0.25)
    rows = pd.read_csv(tmp_path / "sequence" / "sequence.csv").to_dict("records")
    one, two, mean = rows
    assert [row["scene"] for row in rows] == ["one", "two", "mean"]
    assert one["frames"] == two["frames"] == 6
    assert mean["5 cm/5 deg"] == pytest.approx(
        (one["5 cm/5 deg"] + two["5 cm/5 deg"]) / 2
    )
    assert min(one["5 cm/5 deg"], two["5 cm/5 deg"]) > 50
    # Each scene counts its own bytes.
    assert 0.5 < one["bytes"] / two["bytes"] < 2
    settings = json.loads((tmp_path / "sequence" / "sequence.json").read_text())[
        "settings"
    ]
    assert settings["map"]["memory"]["share"] == 0.25
    assert settings["localize"]["align"] is True


def test_images_of_another_scene_are_refused(
    folders: list[Path], tmp_path: Path
) -> None:
    maps.run("unknown", tuple(folders), tmp_path, 0.25)
    rows = pd.read_csv(tmp_path / "unknown" / "unknown.csv")
    assert rows["images"].tolist()[:3] == ["two", "blank", "noise"]
    assert rows["count"].tolist() == [6, 1, 10, 1]
    assert sum(rows["accepted"].tolist()[1:]) == 0


def test_unusable_arguments_are_refused(folders: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sequence: give scenes with --scenes"):
        maps.run("sequence", (), tmp_path)
    (tmp_path / "mini").mkdir()
    with pytest.raises(InputError, match="mini: exists"):
        maps.run("mini", (), tmp_path)
    scene = Recording("empty", (), ())
    generic.write(tmp_path / "empty", scene)
    with pytest.raises(InputError, match="empty"):
        maps.run("unknown", (folders[0], tmp_path / "empty"), tmp_path)


@pytest.mark.parametrize("kind", maps.POSE_ERRORS)
def test_pose_errors_have_their_stated_size(
    arcs: tuple[Recording, Recording], kind: maps.PoseError
) -> None:
    frames = arcs[0].train
    changed = maps.with_pose_errors(frames, kind, 0)
    moved = [maps._moved(a, b) for a, b in zip(frames, changed, strict=True)]
    assert sum(moved) == (1 if kind == "gross" else 0)
    scale = 1.01 if kind == "focal" else 1.0
    assert changed[0].camera.fx == pytest.approx(scale * frames[0].camera.fx)
