"""`benchmarks maps` and `many-keyframes` on tiny rooms: rows, settings, and publication."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import many_keyframes, maps
from benchmarks.publish import publish
from evercal.continual.benchmark.published import read_published
from evercal.errors import InputError
from evercal.recordings import Recording, generic


@pytest.fixture(scope="module")
def folders(
    arcs: tuple[Recording, Recording], tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    root = tmp_path_factory.mktemp("recorded")
    for arc in arcs:
        generic.write(root / arc.name, replace(arc, test=arc.test[::4]))
    return [root / arc.name for arc in arcs]


@pytest.fixture(scope="module")
def sequence(folders: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a measured sequence."""
    out = tmp_path_factory.mktemp("maps")
    maps.run("sequence", tuple(folders), out, 0.25)
    return out / "sequence"


def test_sequence_reports_each_scene_and_their_mean(sequence: Path, tmp_path: Path) -> None:
    source = sequence / "sequence.json"
    one, two, mean = json.loads(source.read_text())["rows"]
    assert [row["scene"] for row in (one, two, mean)] == ["one", "two", "mean"]
    assert one["frames"] == two["frames"] == 6
    assert mean["5 cm/5 deg"] == (one["5 cm/5 deg"] + two["5 cm/5 deg"]) / 2
    assert min(one["5 cm/5 deg"], two["5 cm/5 deg"]) > 50
    # Each scene counts its own bytes.
    assert 0.5 < one["bytes"] / two["bytes"] < 2
    settings = json.loads(source.read_text())["settings"]
    assert settings["map"]["memory"]["share"] == 0.25
    assert settings["localize"]["align"] is True
    assert len(read_published(publish(source, "sequence", {}, out=tmp_path)).rows) == 3


def test_images_of_another_scene_are_refused(folders: list[Path], tmp_path: Path) -> None:
    maps.run("unknown", tuple(folders), tmp_path, 0.25)
    rows = json.loads((tmp_path / "unknown" / "unknown.json").read_text())["rows"]
    assert [row["images"] for row in rows][:3] == ["two", "blank", "noise"]
    assert [row["count"] for row in rows] == [6, 1, 10, 1]
    assert sum(row["accepted"] for row in rows[1:]) == 0


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


def test_scenes_are_localized_among_other_rooms(
    sequence: Path, folders: list[Path], tmp_path: Path
) -> None:
    out, store = tmp_path / "row.json", sequence / "store.evercal"
    many_keyframes.run(store, (folders[0],), 7, 2, out)
    (row,) = read_published(publish(out, "many", {}, out=tmp_path)).rows
    assert [row[key] for key in ("keyframes", "rooms", "frames")] == [6, 2, 6]
    assert row["wrong_scene"] == 0
    assert float(str(row["5 cm/5 deg"])) > 50
    for arguments, message in (
        ((store, (folders[0],), 10, 1, out), "exists"),
        ((store, (folders[0],), 10, 11, tmp_path / "x"), "--rooms 11: give 1 to 10"),
        ((store, (Path(f"attic={folders[0]}"),), 2, 1, tmp_path / "x"), "'attic' is not in the"),
    ):
        with pytest.raises(InputError, match=message):
            many_keyframes.run(*arguments)
