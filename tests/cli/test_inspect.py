"""`evercal inspect`: what is right raises no warning, what is planted is found."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.cli.inspection import Inspection, inspect_scene, roll_deg
from evercal.datasets import Frame, Scene, load_scene
from evercal.geometry import SE3, Camera
from evercal.simulation.box_room import BoxRoom, look_at

LENS = Camera(32, 24, 26, 26, 15.5, 11.5)
PICTURE = np.zeros((24, 32, 3), np.uint8)


def scene(train: SE3, test: SE3, camera: Camera = LENS, untracked: int = 0) -> Scene:
    def frames(poses: SE3, split: str) -> tuple[Frame, ...]:
        count = len(poses)
        return tuple(Frame(f"{split}{i}", PICTURE, camera, poses[i]) for i in range(count))

    return Scene("planted", frames(train, "a"), frames(test, "b"), untracked)


def warned(scene: Scene) -> str:
    return "\n".join(inspect_scene(scene).warnings)


ROOM = BoxRoom(41, furniture=0, texture_px=16)
TRAIN, TEST = ROOM.path(200, 1), ROOM.path(40, 2)


def test_a_sound_scene_is_described_without_a_warning(run: Any, rooms: Any) -> None:
    ran = run("inspect", rooms[0], "--json")
    found = json.loads(ran.out)
    assert found.keys() == {field.name for field in dataclasses.fields(Inspection)}
    assert (found["train"], found["test"], found["untracked"]) == (24, 6, 0)
    assert found["warnings"] == []
    text = run("inspect", rooms[0]).out
    assert "24 training and 6 test frames" in text
    assert text.splitlines()[-1] == f"next: evercal learn STORE {rooms[0]}"


def test_numbers_are_those_of_a_known_path() -> None:
    x = np.linspace(0, 1.9, 20)
    path = SE3.stack([look_at(np.array([v, 0, 1]), np.array([v, 5, 1.5])) for v in x])
    found = inspect_scene(scene(path, path[::4], untracked=3))
    np.testing.assert_allclose(found.extent_m, (1.9, 0, 0), atol=1e-12)
    assert found.step_median_m == pytest.approx(0.1)
    assert found.step_largest_m == pytest.approx(0.1)
    assert found.near_training == 100
    assert found.untracked == 3


def test_planted_faults_are_found() -> None:
    assert warned(scene(TRAIN, TEST)) == ""
    still = SE3(TRAIN.rotation_wxyz, np.zeros((200, 3)))
    rigid = SE3(np.tile(TRAIN.rotation_wxyz[0], (200, 1)), TRAIN.translation_m)
    millimetres = SE3(TRAIN.rotation_wxyz, 1000 * TRAIN.translation_m)
    kilometres = SE3(TRAIN.rotation_wxyz, 0.001 * TRAIN.translation_m)
    shuffled = TRAIN[np.random.default_rng(0).permutation(200)]
    assert "stand at one point" in warned(scene(still, TEST))
    assert "look the same way" in warned(scene(rigid, TEST))
    assert "millimetres" in warned(scene(millimetres, TEST))
    assert "in metres" in warned(scene(kilometres, TEST))
    assert "recorded order" in warned(scene(shuffled, TEST))
    assert "test frames have the pose" in warned(scene(TRAIN, TRAIN[:40]))
    assert "have no pose" in warned(scene(TRAIN, TEST, untracked=300))
    assert "16 or more" in warned(scene(TRAIN[:5], TEST))
    assert "nothing to measure" in warned(scene(TRAIN, TEST[:0]))
    assert "far from the middle" in warned(scene(TRAIN, TEST, Camera(32, 24, 26, 26, 25, 11)))
    assert "sees" in warned(scene(TRAIN, TEST, Camera(32, 24, 525, 525, 15.5, 11.5)))
    assert "square pixels" in warned(scene(TRAIN, TEST, Camera(32, 24, 26, 40, 15.5, 11.5)))


def test_quaternions_in_the_wrong_order_are_found() -> None:
    wrong = SE3(np.roll(TRAIN.rotation_wxyz, 1, axis=1), TRAIN.translation_m)
    assert "w x y z" in warned(scene(wrong, TEST))


def test_roll_is_that_of_the_cameras() -> None:
    eye = np.zeros(3)
    for roll in (0.0, 0.3):
        turns = np.linspace(0, 2 * np.pi, 360, endpoint=False)
        level = [look_at(eye, np.array([np.cos(a), np.sin(a), 0.0]), roll) for a in turns]
        # All lean to the same side: their x axes lie on a cone about gravity.
        assert roll_deg(SE3.stack(level)) == pytest.approx(np.rad2deg(roll), abs=1e-3)
    rng = np.random.default_rng(0)
    everywhere = SE3(rng.normal(size=(4000, 4)), np.zeros((4000, 3)))
    assert roll_deg(everywhere) == pytest.approx(np.rad2deg(np.arcsin(3**-0.5)), abs=1.5)
    assert roll_deg(SE3.exp(np.zeros((20, 6)))) == pytest.approx(0, abs=1e-3)


def test_the_same_files_in_both_splits_are_found(rooms: Any) -> None:
    recorded = load_scene(rooms[0])
    both = dataclasses.replace(recorded, test=recorded.train[:6])
    assert "test frames have the pose or the file" in warned(both)


def test_bad_input_is_one_line(run: Any, rooms: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for words in ([tmp_path], [tmp_path / "file"], [tmp_path / "no"], [rooms[0], "--format", "x"]):
        ran = run("inspect", *words)
        assert (ran.code, ran.out, len(ran.err)) == (2, "", 1)
        assert json.loads(run("inspect", *words, "--json").out).keys() == {"error"}
