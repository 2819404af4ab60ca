"""What made a result: the record of a call, its inputs, and what differs later."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.storage.provenance import Made, call, current, recorded


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "anna"))
    for name in ("rec/a.jpg", "rec/b.jpg", "rec/poses.csv", "one.json", "anna/x.json"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(name)
    return tmp_path


def test_the_outermost_call_is_recorded_and_only_inside_of_it() -> None:
    assert current() is None
    assert recorded() == {}
    with call(("evercal", "learn"), {}):
        with call(("Map.learn",), {}):
            made = current()
        assert current() is made
    assert made is not None
    assert made.command == ("evercal", "learn")
    assert current() is None


def test_inputs_are_files_by_their_ending_and_values(folder) -> None:
    given = {
        "recording": "rec",
        "name": "one.json",
        "camera": Path("one.json"),
        "images": [Path("rec/a.jpg"), Path("rec/b.jpg")],
        "gone": Path("nowhere"),
        "rough": SE3.identity(),
        "progress": print,
    }
    inputs = Made.of(("Map.learn",), given).inputs
    assert set(inputs) == {
        *("rec/*.jpg", "rec/*.csv", "one.json", "rough"),
        *("rec/a.jpg", "rec/b.jpg"),
    }
    assert inputs["rec/*.jpg"].startswith("files: 2, sha256: ")


def test_images_of_a_folder_are_those_in_it_and_a_map_is_its_manifest(folder) -> None:
    Path("rec/more").mkdir()
    Path("rec/more/c.jpg").write_text("c")
    Path("map").mkdir()
    Path("map/manifest.json").write_text("{}")
    Path("map/other.json").write_text("{}")
    given = {"images": Path("rec"), "recording": "rec", "store": Path("map")}
    inputs = [Made.of((), {name: value}).inputs for name, value in given.items()]
    assert inputs[0]["rec/*.jpg"].startswith("files: 2, ")
    assert inputs[1]["rec/*.jpg"].startswith("files: 3, ")
    assert set(inputs[2]) == {"map/manifest.json"}


def test_a_record_names_neither_users_nor_passwords(folder) -> None:
    words = ("evercal", "learn", f"{folder}/anna/m", "s3://me:secret@host/x?key=1")
    made = Made.of(words, {"camera": folder / "anna/x.json"})
    assert made.command[2:] == ("~/m", "s3://host/x")
    assert set(made.inputs) == {"~/x.json"}


def test_changes_name_the_version_and_each_input(folder) -> None:
    before = Made.of(("evercal",), {"recording": Path("rec"), "c": Path("one.json")})
    assert before.changes(before) == []
    Path("rec/b.jpg").write_text("other")
    Path("one.json").unlink()
    given = {"recording": Path("rec"), "c": Path("one.json")}
    now = Made("9.9", before.command, Made.of((), given).inputs, "")
    version, images, gone = sorted(before.changes(now))
    assert version == f"evercal was {before.version} and is 9.9"
    assert images.startswith("one.json was files: 1, sha256: ")
    assert images.endswith(" and is gone")
    assert gone.startswith("rec/*.jpg was files: 2")


def test_a_record_is_read_again_and_a_broken_one_refused(folder) -> None:
    made = Made.of(("evercal", "solve"), {"camera": Path("one.json")})
    assert Made.from_dict(asdict(made)) == made
    assert Made.from_dict(None) is None
    for name, value in (("inputs", 3), ("command", None)):
        with pytest.raises((TypeError, ValueError)):
            Made.from_dict({**asdict(made), name: value})


def test_equal_values_have_equal_checksums() -> None:
    poses = [SE3.exp(np.arange(6) / 10) for _ in range(2)]
    first, second = (Made.of((), {"poses": pose}).inputs for pose in poses)
    assert first == second
