"""A scene learned from poses in an unknown unit of length, before and after `align`."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.cli import main
from evercal.geometry import SE3, pose_distance
from evercal.recordings import write_image

from .conftest import words_of

if TYPE_CHECKING:
    from evercal.recordings import Frame

UNITS = 1.7
"""Units of length of the recording in a metre."""
CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


@pytest.fixture(scope="module")
def phone(hall, tmp_path_factory) -> Path:
    """The training frames of `hall` as a nerfstudio recording."""
    root = tmp_path_factory.mktemp("units") / "phone"
    (root / "images").mkdir(parents=True)
    camera = hall.train[0].camera
    frames = []
    for i, frame in enumerate(hall.train):
        write_image(root / "images" / f"{i:03d}.png", frame.read_image())
        matrix = truth_of(frame).matrix() @ CV_FROM_GL
        matrix[:3, 3] *= UNITS
        frames.append(
            {"file_path": f"images/{i:03d}.png", "transform_matrix": matrix.tolist()}
        )
    intrinsics = {"w": camera.width, "h": camera.height, "fl_x": camera.fx}
    intrinsics |= {"fl_y": camera.fy, "cx": camera.cx + 0.5, "cy": camera.cy + 0.5}
    (root / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    return root


@pytest.fixture(scope="module")
def phone_store(phone) -> Path:
    """A map of `phone`, as scene `hall`; tests do not change it."""
    store = phone.parent / "phone.evercal"
    words = ("learn", store, phone, "--name hall --memory 25%")
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        assert main(words_of(words)) == 0
    assert " mm" not in shown.getvalue()
    next_line = shown.getvalue().splitlines()[-1]
    assert next_line == f"next: evercal align {store} hall IMAGE... --robot-poses FILE"
    return store


@pytest.fixture
def reference(tmp_path) -> Path:
    Calibration("eye_to_hand", SE3.identity(), np.eye(6)).write(
        tmp_path / "reference.json"
    )
    return tmp_path / "reference.json"


def test_calibrations_are_refused(run, phone_store, four_images, reference, tmp_path):
    out = tmp_path / "c.json"
    for words in (
        ("calibrate", phone_store, four_images, "--out", out),
        ("check", phone_store, four_images, "--reference", reference),
        ("watch", phone_store, four_images, "--reference", reference, "--idle", "60"),
    ):
        refusal = run.refused(*words)
        assert "unit of length of its recording is unknown" in refusal
        assert "run 'evercal align' first" in refusal
    assert not out.exists()
    episodes = tmp_path / "episodes"
    shutil.copytree(four_images, episodes / "one")
    np.savetxt(episodes / "one" / "base_from_camera.txt", np.eye(4))
    assert "run 'evercal align' first" in run.refused("audit", phone_store, episodes)


def test_poses_have_no_millimetres(run, phone_store, four_images, hall):
    words = ("localize", phone_store, four_images / "00.png", "--at 0,0,1")
    [image] = run.json(*words)["images"]
    assert (image["status"], image["unit"], image["at"]) == ("ok", "unknown", None)
    truth = UNITS * truth_of(hall.test[3]).translation_m
    np.testing.assert_allclose(
        image["base_from_camera"]["translation_m"], truth, atol=0.01
    )
    assert sum(term["share"] for term in image["error_terms"]) == pytest.approx(1)
    assert all(term["translation_mm"] is None for term in image["error_terms"])
    text = run(*words).out
    assert "in an unknown unit: run 'evercal align' first" in text
    assert " mm" not in text
    assert " m " not in text
    assert " deg" in text


def test_no_command_prints_a_length_in_metres(
    run, phone, phone_store, four_images, tmp_path
):
    wide = json.loads((phone / "transforms.json").read_text())
    for frame in wide["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 1000
    shutil.copytree(phone, tmp_path / "wide")
    (tmp_path / "wide" / "transforms.json").write_text(json.dumps(wide))
    copy = shutil.copytree(phone_store, tmp_path / "copy")
    for words in (
        ("inspect", tmp_path / "wide"),
        ("info", phone_store),
        ("track", phone_store, four_images),
        ("refresh", copy, phone / "images"),
    ):
        ran = run(*words)
        assert ran.code == 0, ran.err
        assert not re.search(r"\d (mm|cm|m)\b", ran.out), ran.out
    assert (
        "no millimetres to measure"
        in run("evaluate", phone_store, f"hall={phone}").err[0]
    )


def test_alignment_gives_metres(run, phone_store, four_images, hall, tmp_path):
    """The scale is estimated without --unknown-scale."""
    store = Path(shutil.copytree(phone_store, tmp_path / "map"))
    rng = np.random.default_rng(0)
    picks = ["image,name,u,v"]
    frames = hall.test[::2]
    points = truth_of(frames[7]).apply(
        rng.uniform([-0.7, -0.5, 1.0], [0.7, 0.5, 2.5], (12, 3))
    )
    for i, frame in enumerate(frames):
        write_image(tmp_path / f"{i}.png", frame.read_image())
        pixels = frame.camera.project(truth_of(frame).inverse().apply(points))
        picks += [f"{i}.png,p{j},{u},{v}" for j, (u, v) in enumerate(pixels)]
    (tmp_path / "picks.csv").write_text("\n".join(picks))
    touched = [f"p{j},{x},{y},{z}" for j, (x, y, z) in enumerate(points)]
    (tmp_path / "points.csv").write_text("\n".join(touched))
    files = ("--points", tmp_path / "points.csv", "--picks", tmp_path / "picks.csv")
    (tmp_path / "fewer.csv").write_text("\n".join(touched[1:]))
    refused = run("align", store, "hall --points", tmp_path / "fewer.csv", *files[2:])
    assert refused.code == 2
    assert f"point 'p0' is not in {tmp_path / 'fewer.csv'}" in refused.err[0]
    ran = run("align", store, "hall", *files, "--base-frame base_link --json")
    assert ran.code == 0, ran.err
    assert ran.json["scale"] == pytest.approx(1 / UNITS, rel=0.01)
    out = tmp_path / "c.json"
    ran = run("calibrate", store, four_images, "--out", out)
    assert ran.code == 0, ran.out
    calibration = read_calibration(out)
    assert calibration.parent_frame == "base_link"
    pose = calibration.parent_from_child
    assert pose_distance(pose, truth_of(hall.test[3]))[0] < 0.02
    [image] = run.json("localize", store, four_images / "00.png")["images"]
    assert image["unit"] == "metres"
    assert image["error_terms"][0]["translation_mm"] > 0


def test_unit_survives_conversion_and_can_be_stated(run, phone, tmp_path):
    from evercal.recordings import load_recording

    assert run("convert", phone, tmp_path / "unknown").code == 0
    assert run("convert", phone, tmp_path / "metres", "--metres").code == 0
    assert not load_recording(phone).metric
    assert not load_recording(tmp_path / "unknown").metric
    stated = load_recording(tmp_path / "metres")
    assert stated.metric
    assert "unit of length" not in stated.notes[0]
    assert "--metres: not used by recordings of format generic" in run.refused(
        "convert", tmp_path / "metres", tmp_path / "again", "--metres"
    )
    scene = tmp_path / "metres" / "scene.json"
    scene.write_text(json.dumps({**json.loads(scene.read_text()), "unit": "feet"}))
    assert "'unit' is 'metres' or 'unknown', got 'feet'" in run.refused(
        "inspect", tmp_path / "metres"
    )
