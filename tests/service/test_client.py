"""The client returns what the methods of `Map` return."""

from __future__ import annotations

import os
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evercal
from evercal import Client, InputError, Map
from evercal.geometry import SE3, pose_distance
from evercal.mapping.store import MapStore
from evercal.recordings import read_image, write_image


@pytest.fixture
def client(hall_service) -> Client:
    return evercal.Client(hall_service.url)


def test_estimates_are_those_of_the_map(client, hall_store, image, hall):
    opened = Map.open(hall_store)
    pixels = read_image(image)
    assert client.scenes == opened.scenes
    camera = hall.test[7].camera
    for source, stated in ((image, None), (pixels, None), (str(image), camera)):
        got: Any = client.localize(source, stated)
        expected: Any = opened.localize(pixels, stated)
        assert (got.status, got.scene, got.inliers) == ("ok", "hall", expected.inliers)
        assert got.support == expected.support > 0
        assert pose_distance(got.base_from_camera, expected.base_from_camera)[0] < 1e-12
        np.testing.assert_array_equal(got.covariance, expected.covariance)


def test_calibrations_and_checks(client, hall_store, hall, tmp_path):
    rng = np.random.default_rng(0)
    opened = Map.open(hall_store)
    frame = hall.test[3]
    for i in range(3):
        noisy = frame.read_image() + rng.normal(0, 4, (240, 320, 3))
        write_image(tmp_path / f"{i}.png", noisy.clip(0, 255).astype("u1"))
    got = client.calibrate(tmp_path, camera=frame.camera)
    expected = opened.calibrate(tmp_path, camera=frame.camera)
    assert got.source == expected.source
    difference = pose_distance(got.parent_from_child, expected.parent_from_child)
    assert max(difference) < 1e-12
    assert [use.name for use in got.images] == ["0.png", "1.png", "2.png"]
    shift = client.check([tmp_path / "0.png"], got)
    again = opened.check([tmp_path / "0.png"], expected)
    assert (shift.same_map, shift.moved) == (True, False)
    assert shift.translation_mm == pytest.approx(again.translation_mm)
    arm = SE3.stack([SE3.identity()] * 3)
    fixed = client.calibrate(tmp_path, robot_poses=arm, mount="eye_to_hand")
    assert fixed.mount == "eye_to_hand"
    with pytest.raises(InputError, match="robot_poses: 1 poses for 3 images"):
        client.calibrate(tmp_path, robot_poses=arm[:1])


def test_a_camera_before_a_held_thing_is_checked(
    serve, hall_map, hall, image, tmp_path
):
    store = tmp_path / "held.evercal"
    held = replace(hall_map.scenes[0], parent_frame="gripper")
    MapStore.create(store).commit(held, {"scene": "hall"})
    opened = Map.open(store)
    arm = SE3.stack([SE3.exp([0.1, 0.2, 0.3, 0.0, 0.1, 0.2])])
    camera = hall.test[7].camera
    with serve(store) as service:
        client = Client(service.url)
        reference = client.calibrate(image, robot_poses=arm, camera=camera)
        shift = client.check(image, reference, robot_poses=arm)
        moved = client.check(image, reference, robot_poses=arm @ arm, camera=camera)
        with pytest.raises(InputError, match=r"scene hall is a thing.*robot.poses"):
            client.check(image, reference)
        with pytest.raises(InputError, match="robot_poses: 2 poses for 1 images"):
            client.check(image, reference, robot_poses=SE3.stack([*arm, *arm]))
    expected = opened.check(image, reference, robot_poses=arm)
    assert not shift.moved
    assert shift.translation_mm == pytest.approx(expected.translation_mm)
    assert moved.moved
    assert moved.translation_mm > 100


def test_refusals_are_the_lines_of_the_service(client, tmp_path):
    with pytest.raises(InputError, match=r"image\.png: 2x2 pixels|camera|aspect|image"):
        client.localize(
            np.zeros((2, 200, 3), np.uint8), evercal.Camera(4, 3, 4.0, 4.0, 2.0, 1.5)
        )
    with pytest.raises(InputError, match=r"gone\.png: cannot be read"):
        client.localize(tmp_path / "gone.png")
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1: no answer"):
        _ = Client("http://127.0.0.1:1").scenes


def test_a_token_is_sent(serve, hall_store, image):
    token = "0123456789abcdef"
    with serve(hall_store, token=token) as service:
        assert Client(service.url, token).localize(image).status == "ok"
        with pytest.raises(InputError, match="send 'Authorization: Bearer TOKEN'"):
            Client(service.url).localize(image)


def test_the_example_asks_a_service(cell, monkeypatch, capsys):
    root = Path(__file__).parents[2]
    folders = [str(root / "src"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(folders))
    script = str(root / "examples" / "08_http.py")
    monkeypatch.setattr(sys, "argv", [script, str(cell / "cell.evercal")])
    runpy.run_path(script, run_name="__main__")
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first.startswith("ok [")
    assert re.fullmatch(r"moved: True, [45]\.\d mm", last)
