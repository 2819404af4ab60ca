"""`evercal.Map` as a user has it: learn, localize, calibrate, check, evaluate, export."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal import (
    Calibration,
    InputError,
    LearnReport,
    Map,
    Recording,
    Shift,
    read_calibration,
)
from evercal.geometry import SE3, pose_distance
from evercal.mapping.build import MapOptions
from evercal.mapping.store import MapStore
from evercal.recordings import write_image
from evercal.recordings.formats import generic
from evercal.recordings.frame import Frame
from evercal.storage import MANIFEST, verify, write_manifest
from evercal.storage.manifest import Manifest

Tree = Callable[[Path], dict[str, str]]
Learned = tuple[Map, tuple[LearnReport, LearnReport]]
Pair = tuple[Recording, Recording]
Rooms = tuple[Recording, ...]
Arm = tuple[Path, SE3]
GRIPPER_FROM_CAMERA = SE3.exp([0.05, -0.02, 0.1, 0.3, 0.2, -1.0])


@pytest.fixture(scope="module")
def learned(
    hall: Recording,
    arcs: Pair,
    tmp_path_factory: pytest.TempPathFactory,
) -> Learned:
    """A map of the hall, learned from its folder, and of an arc, learned from a `Recording`."""
    root = tmp_path_factory.mktemp("map")
    generic.write(root / "hall", hall)
    opened = Map.open(root / "new" / "map")
    assert opened.scenes == ()
    reports = (
        opened.learn(root / "hall"),
        opened.learn(arcs[0], name="arc", memory="300kB"),
    )
    return opened, reports


@pytest.fixture(scope="module")
def hall_only(learned: Learned, tmp_path_factory: Any) -> Map:
    """A map of the hall."""
    file = tmp_path_factory.mktemp("hall") / "map.zip"
    learned[0].pack(file)
    opened = Map.unpack(file, file.parent / "map")
    opened.remove("arc")
    return opened


@pytest.fixture(scope="module")
def arm(hall: Recording, tmp_path_factory: pytest.TempPathFactory) -> Arm:
    """Images of a camera on the gripper beside their poses.csv, and base_from_gripper of each."""
    folder = tmp_path_factory.mktemp("arm")
    frames = hall.test[::3]
    grippers = SE3.stack([truth_of(f) @ GRIPPER_FROM_CAMERA.inverse() for f in frames])
    rows = ["image,x,y,z,qw,qx,qy,qz"]
    for i, (frame, pose) in enumerate(zip(frames, grippers, strict=True)):
        write_image(folder / f"{i}.png", frame.read_image())
        rows.append(
            ",".join(map(str, [f"{i}.png", *pose.translation_m, *pose.rotation_wxyz]))
        )
    (folder / "poses.csv").write_text("\n".join(rows))
    return folder, grippers


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def noisy(frame: Frame, count: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    image = frame.read_image().astype(float)
    return [
        (image + rng.normal(0, 4, image.shape)).clip(0, 255).astype("u1")
        for _ in range(count)
    ]


def test_learned_scenes_and_their_reports(
    learned: Learned,
) -> None:
    opened, (hall, arc) = learned
    assert opened.scenes == (hall.scene, arc.scene) == ("hall", "arc")
    assert (hall.train_frames, hall.held_out_frames) == (26, 4)
    assert hall.frames_kept == 8  # at least; 10 % are two
    assert hall.landmarks > 200
    assert hall.adjusted is not None
    assert hall.hand_eye is None
    assert arc.memory_bytes - hall.memory_bytes <= 300_000
    stored = [
        json.loads(path.read_text())
        for path in sorted(opened.path.rglob("report.json"))
    ]
    assert [report["scene"] for report in stored] == ["hall", "arc"]
    assert stored[0]["adjusted"]["residual_px"] == hall.adjusted.residual_px


def test_images_of_both_scenes_are_located_also_after_opening_again(
    learned: Learned,
    hall: Recording,
    arcs: Pair,
) -> None:
    for opened in (learned[0], Map.open(learned[0].path)):
        for name, frame in (("hall", hall.test[7]), ("arc", arcs[0].test[11])):
            estimate = opened.localize(frame.read_image())
            assert (estimate.status, estimate.scene) == ("ok", name)
            assert estimate.base_from_camera is not None
            assert pose_distance(estimate.base_from_camera, truth_of(frame))[0] < 0.03
        estimate = opened.localize(hall.test[7].read_image(), hall.test[7].camera)
        assert estimate.status == "ok"


def test_fixed_camera_from_a_folder_files_and_arrays(
    hall_only: Map, hall: Recording, tmp_path: Path
) -> None:
    frame = hall.test[3]
    images = noisy(frame, 5)
    for i, image in enumerate(images):
        write_image(tmp_path / f"{i}.png", image)
    files = sorted(tmp_path.iterdir())
    calls: list[int] = []
    calibrations = [
        hall_only.calibrate(source, on_image=lambda: calls.append(1))
        for source in (str(tmp_path), files, np.stack(images))
    ]
    assert len(calls) == 3 * 5
    for calibration in calibrations:
        assert calibration.mount == "eye_to_hand"
        assert pose_distance(calibration.parent_from_child, truth_of(frame))[0] < 0.004
        expected = calibrations[0].parent_from_child.matrix()
        np.testing.assert_array_equal(calibration.parent_from_child.matrix(), expected)
    assert [use.name for use in calibrations[1].images] == list(map(str, files))
    [use] = hall_only.calibrate(files[0], camera=frame.camera).images
    assert use.used


@pytest.mark.parametrize("from_file", [True, False])
def test_camera_on_the_gripper(from_file: bool, hall_only: Map, arm: Arm) -> None:
    folder, grippers = arm
    poses = folder / "poses.csv" if from_file else grippers
    calibration = hall_only.calibrate(folder, robot_poses=poses)
    assert calibration.mount == "eye_in_hand"
    assert pose_distance(calibration.parent_from_child, GRIPPER_FROM_CAMERA)[0] < 0.004
    fixed = hall_only.calibrate(folder, robot_poses=poses, mount="eye_to_hand")
    assert fixed.mount == "eye_to_hand"


@pytest.fixture(scope="module")
def calibration(hall_only: Map, hall: Recording) -> Calibration:
    return hall_only.calibrate(noisy(hall.test[3], 5), camera=hall.test[3].camera)


def test_check_from_one_file(
    hall_only: Map, hall: Recording, calibration: Calibration, tmp_path: Path
) -> None:
    def shift(frame: Frame) -> Shift:
        write_image(tmp_path / "now.png", noisy(frame, 1, seed=1)[0])
        return hall_only.check(tmp_path / "now.png", calibration)

    still = shift(hall.test[3])
    bumped = shift(hall.test[4])
    now = tmp_path / "now.png"
    for path in (now, str(now)):
        assert hall_only.localize(path).status == "ok"
    assert still.same_map
    assert bumped.same_map
    assert not still.moved
    assert bumped.moved
    metres, _ = pose_distance(truth_of(hall.test[3]), truth_of(hall.test[4]))
    assert bumped.translation_mm == pytest.approx(1000 * metres, abs=3)


def test_calibration_is_written_and_exported(
    calibration: Calibration, tmp_path: Path
) -> None:
    calibration.write(tmp_path / "camera.json")
    got = read_calibration(tmp_path / "camera.json")
    # Reading normalises the quaternion, which may change its last digit.
    pose = calibration.parent_from_child
    np.testing.assert_allclose(
        got.parent_from_child.matrix(), pose.matrix(), rtol=0, atol=1e-15
    )
    assert replace(got, parent_from_child=pose).to_dict() == calibration.to_dict()
    frames = {"parent": "base_link", "child": "optical"}
    text = calibration.export("launch_py", tmp_path / "camera.launch.py", **frames)
    assert text
    assert (tmp_path / "camera.launch.py").read_text() == text


def test_evaluate(hall_only: Map, hall: Recording, tmp_path: Path) -> None:
    few = replace(hall, test=hall.test[::10])
    scores = hall_only.evaluate(few)
    assert scores.scenes["hall"].frames == len(few.test)
    assert scores.scenes["hall"].median_translation_cm < 0.5
    generic.write(tmp_path / "hall", few)
    others = [hall_only.evaluate(each) for each in ({"hall": few}, tmp_path / "hall")]
    for other in others:
        assert other.scenes["hall"].median_translation_cm == pytest.approx(
            scores.scenes["hall"].median_translation_cm
        )
    with pytest.raises(InputError, match="attic"):
        hall_only.evaluate({"attic": few})


def test_a_name_that_is_taken_is_refused(
    hall_only: Map, hall: Recording, tree: Tree
) -> None:
    before = tree(hall_only.path)
    with pytest.raises(InputError, match="scene 'hall': a scene of this name exists"):
        hall_only.learn(hall)
    for name in ("", " ", "a/b", ".hidden", "a=b", "a\n"):
        with pytest.raises(InputError, match="scene name"):
            hall_only.learn(hall, name=name)
    assert tree(hall_only.path) == before


def test_memory_in_megabytes_and_auto(arcs: Pair, tmp_path: Path) -> None:
    opened = Map(MapStore.create(tmp_path / "map", short_side=120))
    quick = MapOptions(adjust=False)
    one = opened.learn(arcs[0], name="one", memory="0.1MB", options=quick)
    assert 0 < one.memory_bytes <= 100_000
    auto = opened.learn(arcs[0], name="two", memory="auto", options=quick)
    assert 1 <= auto.frames_kept <= 8
    frame = arcs[0].test[9]
    estimate = Map.open(tmp_path / "map").localize(frame.read_image())
    assert estimate.base_from_camera is not None
    assert pose_distance(estimate.base_from_camera, truth_of(frame))[0] < 0.03


@pytest.mark.parametrize("step", ["encoding", "adjusting"])
def test_interrupted_learning_leaves_the_map_unchanged(
    step: str, hall_only: Map, rooms: Rooms, hall: Recording, tree: Tree
) -> None:
    def interrupt(name: str, done: int, total: int) -> None:
        if name == step:
            raise KeyboardInterrupt

    before = tree(hall_only.path)
    with pytest.raises(KeyboardInterrupt):
        hall_only.learn(rooms[0], on_progress=interrupt)
    assert tree(hall_only.path) == before
    assert hall_only.scenes == Map.open(hall_only.path).scenes == ("hall",)
    assert hall_only.localize(hall.test[9].read_image()).status == "ok"
    assert verify(hall_only.path) == []


def test_interrupted_first_learning_leaves_no_map(arcs: Pair, tmp_path: Path) -> None:
    def interrupt(name: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Map.open(tmp_path / "map").learn(arcs[0], on_progress=interrupt)
    assert Map.open(tmp_path / "map").scenes == ()


def test_stores_of_networks_and_other_folders_are_refused(
    hall_only: Map, tmp_path: Path
) -> None:
    store = MapStore.open(hall_only.path)
    root = tmp_path / "networks"
    root.mkdir()
    manifest = Manifest.read(store.root)
    empty = {"networks": [], "stages": []}
    payload = {
        **manifest.payload,
        "kind": "networks",
        "strategy": "sars_pixels",
        **empty,
    }
    write_manifest(root, payload, [])
    with pytest.raises(
        InputError, match=rf"{root}: holds networks of strategy 'sars_pixels'"
    ):
        Map.open(root)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"")
    with pytest.raises(InputError, match="photos: exists and is not an evercal store"):
        Map.open(tmp_path / "photos")
    (root / MANIFEST).write_text("{")
    with pytest.raises(InputError, match=MANIFEST):
        Map.open(root)


def test_a_second_object_of_one_map_does_not_overwrite_its_scenes(
    rooms: Rooms, tmp_path: Path
) -> None:
    first, second = (
        Map(MapStore.create(tmp_path / "map", short_side=64)) for _ in range(2)
    )
    first.learn(rooms[0], options=MapOptions(adjust=False))
    with pytest.raises(InputError, match="another process has changed it"):
        second.learn(rooms[1])
    assert Map.open(tmp_path / "map").scenes == ("alpha",)


def test_a_merged_map_gives_the_answers_of_one_that_learned_in_turn(
    learned: Learned,
    hall: Recording,
    arcs: Pair,
    tmp_path: Path,
) -> None:
    turn = Map.open(learned[0].path)
    turn.pack(tmp_path / "turn.zip")
    Map.unpack(tmp_path / "turn.zip", tmp_path / "hall").remove("arc")
    Map.unpack(tmp_path / "turn.zip", tmp_path / "arc").remove("hall")
    merged = Map.open(tmp_path / "merged")
    joined = merged.merge(tmp_path / "hall", tmp_path / "arc")
    assert joined.added == merged.scenes == turn.scenes == ("hall", "arc")
    images = [scene.test[i].read_image() for scene in (hall, arcs[0]) for i in (3, 12)]
    for image in images:
        expected = turn.localize(image)
        estimate = merged.localize(image)
        assert (estimate.status, estimate.scene) == ("ok", expected.scene)
        assert estimate.support == expected.support
        for one, other in (
            (estimate.uncertain_pose, expected.uncertain_pose),
            (estimate.uncertain_pose, merged.localizer.localize(image).uncertain_pose),
        ):
            assert one is not None
            assert other is not None
            np.testing.assert_array_equal(one.pose.matrix(), other.pose.matrix())
            np.testing.assert_array_equal(one.covariance, other.covariance)


def test_a_scene_is_renamed_and_removed_while_a_localizer_answers(
    hall_only: Map, hall: Recording, tmp_path: Path
) -> None:
    hall_only.pack(tmp_path / "hall.zip")
    opened = Map.unpack(tmp_path / "hall.zip", tmp_path / "map")
    opened.merge(hall_only.path, on_clash="rename")
    opened.rename("hall", "first")
    before = opened.localizer
    image = hall.test[9].read_image()
    opened.remove("first")
    assert opened.scenes == ("hall-2",)
    assert opened.localize(image).scene == "hall-2"
    assert before.localize(image).scene in ("first", "hall-2")
    assert before.scenes == ("first", "hall-2")
    opened.remove("hall-2")
    with pytest.raises(InputError, match="no scene learned yet"):
        opened.localize(image)
