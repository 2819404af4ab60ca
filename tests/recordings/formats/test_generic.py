"""The generic folder format: round trips, and damage named."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording, generic, load_recording
from evercal.recordings.images import write_image

from ..checks import refused

WIDE = Camera(32, 24, 30.25, 31.5, 15.5, 11.5, (0.1, -0.02, 0.001, 0.002, 0.03))
TALL = Camera(24, 32, 30.0, 30.0, 11.5, 15.5)


def make_recording() -> Recording:
    rng = np.random.default_rng(0)

    def frame(i: int, camera: Camera, gripper: bool = False) -> Frame:
        image = rng.integers(0, 255, (camera.height, camera.width, 3), np.uint8)
        pose = SE3.exp(rng.normal(size=6))
        arm = SE3.exp(rng.normal(size=6)) if gripper else None
        return Frame(f"shot/{i}", image, camera, pose, arm)

    train = (frame(0, WIDE), frame(1, TALL, gripper=True), frame(2, WIDE))
    unposed = Frame("shot/3", train[0].image, WIDE, None)
    return Recording("the café", train, (frame(4, TALL), unposed), untracked=7)


def poses_equal(a: SE3 | None, b: SE3 | None) -> bool:
    if a is None or b is None:
        return a is b
    return np.allclose(a.matrix(), b.matrix(), rtol=0, atol=1e-15)


def assert_same(a: Recording, b: Recording) -> None:
    assert (a.name, a.untracked) == (b.name, b.untracked)
    for ours, theirs in ((a.train, b.train), (a.test, b.test)):
        assert [frame.name for frame in ours] == [frame.name for frame in theirs]
        for x, y in zip(ours, theirs, strict=True):
            assert x.camera == y.camera
            assert poses_equal(x.base_from_camera, y.base_from_camera)
            assert poses_equal(x.base_from_gripper, y.base_from_gripper)
            np.testing.assert_array_equal(x.read_image(), y.read_image())


def test_round_trip_is_exact(tmp_path: Path) -> None:
    recording = make_recording()
    generic.write(tmp_path / "a", recording)
    read = load_recording(tmp_path / "a")
    assert_same(recording, read)
    # From files this time: images are copied, not encoded again.
    generic.write(tmp_path / "b", read)
    assert_same(recording, load_recording(tmp_path / "b"))
    first, second = ((tmp_path / n / "scene.json").read_bytes() for n in "ab")
    assert first == second


def test_depth_and_joint_angles_are_written(tmp_path: Path) -> None:
    depth = tmp_path / "depth.png"
    depth.write_bytes(b"any bytes: depth is copied, not decoded")
    first, second, _ = make_recording().train
    first = replace(first, depth=depth, joints_rad=(0.1, -0.2, 0.3))
    generic.write(tmp_path / "a", Recording("arm", (first, second), ()))
    first, second = load_recording(tmp_path / "a").train
    copied = tmp_path / "a/depth/000000.png"
    assert first.depth == copied
    assert copied.read_bytes() == depth.read_bytes()
    assert first.joints_rad == (0.1, -0.2, 0.3)
    assert (second.depth, second.joints_rad) == (None, None)


def test_interrupted_recording_has_no_scene_file(tmp_path: Path) -> None:
    with suppress(RuntimeError), generic.SceneWriter(tmp_path, "x") as writer:
        writer.add(make_recording().train[0], "train")
        raise RuntimeError("plug pulled")
    refused("images without poses; add", load_recording, tmp_path)


def test_writer_refuses_existing_scenes_and_repeated_names(tmp_path: Path) -> None:
    recording = make_recording()
    generic.write(tmp_path, recording)
    refused(r"scene\.json: already there", generic.write, tmp_path, recording)
    with generic.SceneWriter(tmp_path / "other", "x") as writer:
        writer.add(recording.train[0], "train")
        refused("'shot/0': already written", writer.add, recording.train[0], "test")


def numbered(folder: Path, count: int) -> Recording:
    """Images that show their number, as files."""
    folder.mkdir(parents=True)
    camera = Camera(4, 3, 4.0, 4.0, 1.5, 1.0)
    frames = []
    for i in range(count):
        path = folder / f"{i:06d}.png"
        write_image(path, np.full((3, 4, 3), i, np.uint8))
        frames.append(Frame(str(i), path, camera, SE3.identity()))
    return Recording("x", tuple(frames), ())


def shown(recording: Recording) -> list[int]:
    return [int(frame.read_image()[0, 0, 0]) for frame in recording.train]


def test_source_images_are_never_overwritten(tmp_path: Path) -> None:
    recording = numbered(tmp_path / "source" / "images", 4)
    fewer = replace(recording, train=recording.train[::2])
    there = r"000001\.png: already there; give a new folder"
    # In place, where image 1 would become image 2.
    refused(there, generic.write, tmp_path / "source", fewer)
    # Through hard links that an earlier copy left, whether its scene.json was removed ...
    out = tmp_path / "out"
    generic.write(out, recording, link=True)
    (out / generic.FILE).unlink()
    for _ in range(2):  # a refusal leaves nothing that would allow it afterwards
        refused(there, generic.write, out, fewer)
    # ... or it was cut off.
    other = tmp_path / "other"
    writer = generic.SceneWriter(other, "x", link=True)
    for frame in recording.train:
        writer.add(frame, "train")
    refused(there, generic.write, other, fewer)
    assert shown(recording) == [0, 1, 2, 3]


def test_failed_copies_name_the_source_or_the_target(tmp_path: Path) -> None:
    recording = numbered(tmp_path / "source", 1)
    (tmp_path / "out/images").mkdir(parents=True)
    (tmp_path / "out/images/000000.png").symlink_to(tmp_path / "nowhere/000000.png")
    message = r"images/000000\.png: cannot be written \("
    refused(message, generic.write, tmp_path / "out", recording)
    (tmp_path / "source/000000.png").unlink()
    message = r"source/000000\.png: cannot be copied \(No such file"
    refused(message, generic.write, tmp_path / "other", recording)


def test_unknown_keys_are_ignored(tmp_path: Path) -> None:
    recording = make_recording()
    generic.write(tmp_path, recording)
    file = tmp_path / "scene.json"
    data = json.loads(file.read_text())
    data["robot"] = "UR5e"
    data["cameras"]["0"]["serial"] = 5
    for entry in data["frames"]:
        entry["exposure_ms"] = 4.5
    file.write_text(json.dumps(data))
    assert_same(recording, load_recording(tmp_path))


POSE = "frames 0 base_from_camera"
BREAKS = [
    ("format", "other", "'format' is not 'evercal-scene'"),
    ("version", 2, "version 2; this evercal reads 1"),
    ("frames", [], "at least one frame"),
    ("frames", {}, "'frames' is a list"),
    ("cameras", [], "'cameras' is an object"),
    ("cameras 1 fx", -1, "camera '1': camera fx"),
    ("untracked", "many", "'untracked' is a count"),
    ("frames 0 image", "../secret.png", "stays inside"),
    ("frames 0 image", "images\\..\\..\\secret.png", "stays inside"),
    ("frames 0 image", "C:/secret.png", "relative"),
    ("frames 0 image", "/etc/hosts", "relative"),
    ("frames 0 camera", "9", r"frame 0: 'camera' is one of \['0', '1'\], got '9'"),
    ("frames 0 camera", [], "frame 0: 'camera'"),
    ("frames 0 split", "val", "'train' or 'test', got 'val'"),
    ("frames 0 name", "shot/1", "'shot/1' comes twice"),
    (POSE, [1, 2], "frame 0: 'base_from_camera'"),
    (f"{POSE} translation_m", [1, 2], "'translation_m' is 3 numbers"),
    (f"{POSE} translation_m", [1, 2, "3"], "'translation_m' is 3 numbers"),
    (f"{POSE} translation_m", [10**400, 0, 0], "too large"),
    (f"{POSE} quaternion_wxyz", [0, 0, 0, 0], "has length 1"),
    (
        "frames 0 base_from_gripper",
        {"translation_m": [0, 0, 0]},
        "'quaternion_wxyz' is 4",
    ),
    ("frames 0", "frame", "frame 0: is an object"),
]


@pytest.mark.parametrize(("where", "value", "message"), BREAKS)
def test_broken_files_are_refused_in_one_line(
    tmp_path: Path, where: str, value: object, message: str
) -> None:
    generic.write(tmp_path, make_recording())
    file = tmp_path / "scene.json"
    data = target = json.loads(file.read_text())
    *keys, last = (int(key) if key == "0" else key for key in where.split())
    for key in keys:
        target = target[key]
    target[last] = value
    file.write_text(json.dumps(data))
    refused(f"{tmp_path}.*{message}", load_recording, tmp_path)


@pytest.mark.parametrize("name", ["scene.json", "transforms.json"])
@pytest.mark.parametrize("text", ["", "{", "[]", "null", "\x00"])
def test_other_files_are_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    refused(name, load_recording, tmp_path)


def test_formats_are_recognised(tmp_path: Path) -> None:
    root = tmp_path / "a"
    generic.write(root, make_recording())
    assert load_recording(root, format="generic", name="lab").name == "lab"
    message = "use one of generic, 7scenes"
    refused(message, load_recording, root, format="gopro")
    refused("no such folder", load_recording, tmp_path / "b")
    for part in (generic.FILE, "images"):
        refused("a part of a recording; give", load_recording, root / part)
