"""`evercal learn`: what it prints, how it goes on after a stop, what it refuses."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from evercal.cli.learn_bars import LearnBars

from evercal.cli.learn import check_name, parse_memory
from evercal.errors import InputError
from evercal.recordings import Recording, load_recording, posed_recording


def test_first_and_last_line_and_the_report(run: Any, tmp_path: Path, rooms: Any) -> None:
    from evercal.continual.learn_scene import LearnReport

    told = run("learn", tmp_path / "s", rooms[0], "--name", "cell", "--memory", "60kB")
    first, *_, last = told.out.splitlines()
    assert told.code == 0
    assert first.startswith("cell: 24 training frames, 0 untracked left out, ")
    assert last == f"next: evercal evaluate {tmp_path / 's'} cell={rooms[0]}"
    # The store is of strategy evercal, so the second scene is learned with it unasked.
    ran = run("learn", tmp_path / "s", rooms[1], "--json")
    report = json.loads(ran.out)
    assert report["landmarks"] > 50
    assert report["adjusted"]["wrong_poses"] == []
    assert set(report) == {field.name for field in dataclasses.fields(LearnReport)}
    assert {"seconds", "iterations", "memory_bytes", "head_bytes", "frames_kept"} <= set(report)
    assert report["scene"] == "box-room-42"
    assert report["iterations"] == 0  # a map is built, nothing is trained
    assert report["frames_kept"] == 2  # 10 % of the frames that are not held out
    assert len(ran.err) == 1  # the line about frames; the rest is progress
    info = json.loads(run("info", tmp_path / "s", "--json").out)
    assert [scene["name"] for scene in info["scenes"]] == ["cell", "box-room-42"]
    assert 0 < info["scenes"][0]["memory_bytes"] <= 70_000


def test_after_a_stop_the_same_command_goes_on(
    run: Any, tmp_path: Path, rooms: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    show = LearnBars.__call__

    def stop(self: LearnBars, event: Any) -> None:
        show(self, event)
        if hasattr(event, "inlier_share") and event.step == 2:
            raise KeyboardInterrupt

    words = ("learn", tmp_path / "s", rooms[0], "--strategy", "finetune", "--json")
    with monkeypatch.context() as patch:
        patch.setattr(LearnBars, "__call__", stop)
        ran = run(*words)
    assert ran.code == 130
    assert ran.out == ""
    assert ran.err[-1] == "stopped; the same command continues where it stopped"
    assert "Traceback" not in "".join(ran.err)
    report = json.loads(run(*words).out)
    assert report["resumed"]
    assert report["frames_kept"] == 0
    # The strategy of the store is taken when none is given, and no other is.
    assert run("learn", tmp_path / "s", rooms[1]).code == 0
    assert json.loads(run("info", tmp_path / "s", "--json").out)["strategy"] == "finetune"


BAD_OPTIONS = [
    (["--strategy", "joint"], "for the benchmark only"),
    (["--strategy", "nonsense"], "evercal, evercal_network, evercal_hybrid, finetune"),
    (["--strategy", "finetune"], "'evercal'"),
    (["--memory", "lots"], "--memory lots"),
    (["--memory", "0%"], "--memory 0%"),
    (["--centres", "0"], ">= 1"),
    (["--centres", "7"], "evercal trains no network"),
    (["--seed", "-1"], ">= 0"),
    (["--encoder", "missing.safetensors"], "no such file"),
    (["--encoder", __file__], "keeps the encoder"),
    (["--format", "png"], "generic, 7scenes"),
    (["--format", "7scenes"], "TrainSplit.txt"),
    (["--name", "box-room-41"], "a scene of this name"),
    (["--name", "a/b"], "no slash"),
    (["--name", ""], "not empty"),
]


@pytest.mark.parametrize(("options", "said"), BAD_OPTIONS)
def test_bad_options_are_one_line_and_leave_the_store(
    run: Any, store: Path, rooms: Any, snapshot: Any, options: list[str], said: str
) -> None:
    before = snapshot(store)
    ran = run("learn", store, rooms[1], *options)
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert said in ran.err[0]
    assert snapshot(store) == before
    assert json.loads(run("learn", store, rooms[1], *options, "--json").out).keys() == {"error"}


def test_a_network_keeps_the_centres_it_was_made_with(
    run: Any, rooms: Any, snapshot: Any, tmp_path: Path
) -> None:
    words = ("learn", tmp_path / "s")
    assert run(*words, rooms[0], "--strategy", "finetune", "--centres", "5").code == 0
    before = snapshot(tmp_path / "s")
    ran = run(*words, rooms[1], "--centres", "7")
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert "was made with 5" in ran.err[0]
    assert snapshot(tmp_path / "s") == before
    assert run(*words, rooms[1], "--centres", "5").code == 0


def test_a_new_map_has_no_centres(run: Any, rooms: Any, tmp_path: Path) -> None:
    ran = run("learn", tmp_path / "s", rooms[0], "--centres", "5")
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert "evercal trains no network" in ran.err[0]
    assert not (tmp_path / "s").exists()


def damaged(kind: str, room: Path, folder: Path) -> Path:
    """A scene with something wrong."""
    shutil.copytree(room, folder)
    data = json.loads((folder / "scene.json").read_text())
    if kind == "missing scene":
        return folder / "nowhere"
    if kind == "no scene":
        (folder / "scene.json").unlink()
    elif kind == "missing image":
        (folder / "images/000003.png").unlink()
    elif kind == "broken json":
        (folder / "scene.json").write_text("{")
    elif kind == "few frames":
        data["frames"] = data["frames"][:5]
    elif kind == "no poses":
        for frame in data["frames"]:
            frame["base_from_camera"] = None
    elif kind == "escape":
        data["name"] = "../../escape"
    if kind in ("few frames", "no poses", "escape"):
        (folder / "scene.json").write_text(json.dumps(data))
    return folder


@pytest.mark.parametrize(
    "kind",
    [
        "missing scene",
        "no scene",
        "missing image",
        "broken json",
        "few frames",
        "no poses",
        "escape",
    ],
)
@pytest.mark.parametrize("new", [False, True])
def test_bad_scenes_are_one_line_and_leave_the_store(
    run: Any, store: Path, rooms: Any, snapshot: Any, tmp_path: Path, kind: str, new: bool
) -> None:
    into = tmp_path / "new" if new else store
    before = snapshot(into)
    ran = run("learn", into, damaged(kind, rooms[1], tmp_path / "scene"))
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert snapshot(into) == before
    assert into.exists() is not new


def test_an_image_that_breaks_later_leaves_every_file_that_counts(
    run: Any, store: Path, rooms: Any, snapshot: Any, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(store, tmp_path / "store"))
    before = snapshot(copy)
    shutil.copytree(rooms[1], tmp_path / "scene")
    (tmp_path / "scene/images/000003.png").write_bytes(b"no image")
    ran = run("learn", copy, tmp_path / "scene")
    assert ran.code == 2
    assert len(ran.err) == 1
    assert "000003.png" in ran.err[0]
    after = snapshot(copy)
    assert {name: after[name] for name in before} == before
    assert all(name.split(os.sep)[0] == "learning" for name in after.keys() - before.keys())
    assert run("verify", copy).code == 0


def test_what_is_not_a_store_is_left_alone(
    run: Any, rooms: Any, snapshot: Any, tmp_path: Path
) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home/letter.txt").write_text("dear")
    ran = run("learn", tmp_path / "home", rooms[0])
    assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
    assert snapshot(tmp_path / "home") == {"letter.txt": b"dear"}
    (tmp_path / "file").write_text("x")
    assert run("learn", tmp_path / "file", rooms[0]).code == 2


@pytest.mark.parametrize(
    ("text", "share", "count"),
    [
        ("10%", 0.1, None),
        ("2.5 %", 0.025, None),
        ("100%", 1.0, None),
        ("5MB", None, 5_000_000),
        ("5 mb", None, 5_000_000),
        ("1.5KiB", None, 1536),
        ("2GiB", None, 2**31),
        ("1000", None, 1000),
        ("7B", None, 7),
    ],
)
def test_memory_is_a_share_or_bytes(text: str, share: float | None, count: int | None) -> None:
    assert parse_memory(text) == (pytest.approx(share) if share else None, count)


@pytest.mark.parametrize(
    "text", ["", "%", "0%", "101%", "-5%", "5XB", "0", "0.5", "1e6", "5 5MB", "iB"]
)
def test_other_memories_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="--memory"):
        parse_memory(text)


@pytest.mark.parametrize(
    "name", ["", " ", ".", "..", ".hidden", "a/b", "a\\b", "a=b", "a\nb", "a\0"]
)
def test_names_that_are_no_single_word_of_a_path_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="scene name"):
        check_name(name)


def test_frames_without_a_pose_count_as_untracked(rooms: Any) -> None:
    scene = load_recording(rooms[0])
    lost = tuple(dataclasses.replace(frame, base_from_camera=None) for frame in scene.train[:3])
    mixed = Recording("mixed", lost + scene.train[3:], scene.test, untracked=4)
    assert posed_recording(mixed).train == scene.train[3:]
    assert posed_recording(mixed).untracked == 7
