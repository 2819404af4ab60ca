"""`evercal map`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from evercal.cli import main
from evercal.storage import Manifest, write_manifest


@pytest.fixture
def copy(hall_store, tmp_path) -> Path:
    return Path(shutil.copytree(hall_store, tmp_path / "copy"))


def scenes(run: Any, store: Path) -> list[str]:
    ran = run("map list", store, "--json")
    assert ran.code == 0
    return [scene["name"] for scene in ran.json["scenes"]]


def test_a_map_is_packed_unpacked_merged_renamed_and_emptied(run, copy, tmp_path):
    ran = run("map list", copy)
    assert ran.out.startswith("hall: 7 keyframes, ")
    ran = run("map pack", copy, tmp_path / "hall.zip")
    assert (ran.code, ran.err) == (0, [])
    assert (
        ran.out.splitlines()[-1]
        == f"next: evercal map unpack {tmp_path / 'hall.zip'} MAP"
    )
    record = run.json("map pack", copy, tmp_path / "hall.zip")
    assert record["bytes"] == (tmp_path / "hall.zip").stat().st_size
    two = tmp_path / "two"
    ran = run("map unpack", tmp_path / "hall.zip", two, "--json")
    assert ran.json == {"store": str(two), "scenes": ["hall"]}
    assert run("map rename", two, "hall lobby").code == 0
    record = run.json("map merge", tmp_path / "new", copy, two)
    assert record["added"] == record["scenes"] == ["hall", "lobby"]
    ran = run("map merge", two, tmp_path / "new", "--on-clash rename")
    assert ran.out.startswith("added hall, lobby-2; lobby is now lobby-2; scenes of ")
    assert scenes(run, two) == ["lobby", "hall", "lobby-2"]
    ran = run("map remove", two, "lobby lobby-2 hall")
    assert (ran.code, ran.out.splitlines()[0][-4:]) == (0, "none")
    assert run("map list", two).out == f"{two}: no scene\n"


@pytest.mark.parametrize(
    "action", ["list", "remove", "rename", "merge", "pack", "unpack"]
)
def test_help_of_an_action_has_an_example(action, capsys):
    assert main(["map", action, "--help"]) == 0
    page = capsys.readouterr().out
    assert f"Example: evercal map {action} " in page
    assert "--json" in page


def test_control_characters_reach_no_terminal(run, copy, four_images, tmp_path):
    images = tmp_path / "a\x1b]0;title\x07"
    images.mkdir()
    for number, path in enumerate(sorted(four_images.iterdir())[:2]):
        shutil.copy(path, images / f"{number}\x1b[31m\x9b2J\u202e.png")
    moved = Path(shutil.move(copy, tmp_path / "map\x1b[2J"))

    def shown(*words: object) -> str:
        ran = run(*words)
        text = ran.out + "\n".join(ran.err)
        assert text.replace("\n", "").isprintable(), text
        return text

    assert "0\\x1b[31m\\x9b2J\\u202e.png" in shown("localize", moved, images)
    assert "map\\x1b[2J: 1 scene" in shown("info", moved)
    shown("map", "list", moved)
    shown("localize", moved, tmp_path / "\x1b[31m")
    shown("inspect", images)
    shown("no\x1b[31m", moved)
    shown("info", moved, "--\x1b[31m")
    (file,) = moved.rglob("scene.json")
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "name": "hall\x1b[2J\x1b]0;\x07\x9bm\nx"}))
    manifest = Manifest.read(moved)
    write_manifest(moved, manifest.payload, list(manifest.files))
    for words in (
        ("map", "list", moved),
        ("map", "rename", moved, "a", "b"),
        ("info", moved),
        ("localize", moved, images),
    ):
        text = shown(*words)
        assert "scene name 'hall\\x1b[2J" in text
