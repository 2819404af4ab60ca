"""`evercal convert`, and the reading options that it shares with `inspect` and `learn`."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from benchmarks import layouts
from evercal.cli.args import Reading
from evercal.geometry import SE3, pose_distance
from evercal.recordings import (
    FORMATS,
    ReadOptions,
    generic,
    load_recording,
    write_image,
)
from evercal.recordings.samples import sample_rooms


@pytest.fixture
def wave(tmp_path) -> Path:
    """A wrist recording of four images; the camera file is in the folder above."""
    root = tmp_path / "wave"
    root.mkdir()
    rows = ["x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z"]
    for i in range(4):
        write_image(root / f"{i}.png", np.full((24, 32, 3), 10 * i, np.uint8))
        rows.append(f"0.{i},0.2,0.3,0.0,0.{i},0.0")
    (root / "base_from_gripper.csv").write_text("\n".join(rows))
    (tmp_path / "camera.txt").write_text("30 0 15.5\n0 30 11.5\n0 0 1\n")
    return root


@pytest.mark.parametrize("options", [[], ["--hard-link"]])
def test_recording_is_converted_to_a_scene_folder(run, wave, tmp_path, options):
    out = tmp_path / "out"
    words = [
        "convert",
        wave,
        out,
        "--camera",
        tmp_path / "camera.txt",
        "--name cell",
        *options,
    ]
    ran = run(*words, "--json")
    assert (ran.code, ran.err) == (0, [])
    record = ran.json
    counts = [record[key] for key in ("train", "test", "untracked")]
    assert (record["name"], counts) == ("cell", [4, 0, 0])
    assert (record["with_base_from_camera"], record["with_base_from_gripper"]) == (0, 4)
    scene = load_recording(out)
    assert scene.name == "cell"
    assert scene.notes == tuple(record["notes"])
    assert "in order" in scene.notes[0]
    for i, frame in enumerate(scene.train):
        assert frame.base_from_gripper is not None
        expected = SE3.exp([0, 0, 0, 0, i / 10, 0]).rotation_wxyz
        pose = SE3(expected, np.array([i / 10, 0.2, 0.3]))
        assert max(pose_distance(frame.base_from_gripper, pose)) < 1e-12
        assert int(frame.read_image().mean()) == 10 * i
        assert isinstance(frame.image, Path)
        assert frame.image.samefile(wave / f"{i}.png") == bool(options)
    assert "already there" in run.refused(*words)


def test_next_command_repeats_the_reading_options(run, wave):
    camera = wave.parent / "camera.txt"
    ran = run("inspect", wave, "--every", 2, "--camera", camera)
    assert "2 training and 0 test frames with the gripper's pose" in ran.out
    assert "gripper moved in 0.2 x 0 x 0 m" in ran.out
    assert "note: images and poses were paired in order" in ran.out
    last = ran.out.splitlines()[-1]
    assert last == f"next: evercal learn MAP {wave} --camera {camera} --every 2"


def test_poses_of_the_depth_camera_are_converted(run, tmp_path):
    room = sample_rooms()[0].scene
    scene = layouts.FakedScene(room, layouts.SEVEN_CAMERA, 0)
    layouts.write_seven(tmp_path, "heads", scene, 2)
    heads = tmp_path / "7scenes/heads"
    ran = run("convert", heads, tmp_path / "out", "--poses", "colour")
    assert "1 training and 2 test frames" in ran.out
    pose = load_recording(tmp_path / "out").train[0].base_from_camera
    assert pose is not None
    truth = room.train[0].base_from_camera
    assert truth is not None
    assert max(pose_distance(pose, truth)) < 1e-6


def test_options_are_those_of_load_recording(run):
    names = {field.name: field.default for field in dataclasses.fields(Reading)}
    assert names.pop("format") is None
    options = {field.name: field.default for field in dataclasses.fields(ReadOptions)}
    assert options.pop("whole_robot") is False  # `arm-in-view` reads so
    assert options.pop("unchecked_joints") is False  # `inspect` checks them itself
    assert names == options
    text = run("inspect --help").out.replace("│", "")
    page = " ".join(text.split())
    for name in FORMATS:
        assert f" {name}" in page[page.index("Format of the recording") :]
    for verb in ("learn", "convert", "inspect"):
        shown = run(verb, "--help").out
        for name in names:
            assert "--" + name.replace("_", "-") in shown


@pytest.mark.parametrize("verb", ["convert", "inspect", "learn"])
def test_bad_input_is_one_line(run, wave, tmp_path, verb):
    camera = tmp_path / "camera.txt"
    (tmp_path / "file").write_text("x")
    room = tmp_path / "room"
    generic.write(room, load_recording(wave, options=ReadOptions(camera=camera)))
    before, after = {
        "convert": ([], [tmp_path / "new"]),
        "inspect": ([], []),
        "learn": ([tmp_path / "store"], []),
    }[verb]
    for scene, words, message in (
        (wave, [], "no camera file in it"),
        (wave, ["--camera", tmp_path / "no"], "camera file is missing"),
        (
            wave,
            ["--camera", camera, "--image-topic", "/a"],
            "--image-topic: not used by",
        ),
        (
            room,
            ["--camera", camera],
            "--camera: not used by recordings of format generic",
        ),
        (room, ["--every", 0], "--every 0: give a number >= 1"),
        (tmp_path / "file", [], "a file, not a folder"),
        (tmp_path / "no", [], "no such folder"),
    ):
        assert message in run.refused(verb, *before, scene, *after, *words)
        assert not (tmp_path / "new").exists()
        assert not (tmp_path / "store").exists()
    if verb == "convert":
        assert "is a file; give a folder" in run.refused(verb, room, tmp_path / "file")
