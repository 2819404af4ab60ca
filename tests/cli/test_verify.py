"""`evercal verify`."""

from __future__ import annotations

import json
import threading
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.evidence import plus
from evercal.geometry import SE3, Camera
from evercal.recordings import write_image
from evercal.service.picking import PickServer
from evercal.simulation.box_room import look_at

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
TRIPOD = look_at(np.array([0.1, 0.5, 0.7]), np.array([0.5, 0.0, 0.05]))
TOUCHED = "--points touched.csv --picks picks.csv"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A calibration, the same of a camera that was moved, and five touched points."""
    monkeypatch.chdir(tmp_path)
    sigma = np.repeat([1e-3, np.deg2rad(0.05)], 3)
    own = Calibration("eye_to_hand", TRIPOD, np.diag(sigma**2), camera=CAMERA)
    own.write("tripod.json")
    moved = plus(TRIPOD, np.array([0.01, 0, 0, 0, 0, 0]))
    replace(own, parent_from_child=moved).write("moved.json")
    rng = np.random.default_rng(0)
    points = np.array([0.5, 0, 0.05]) + rng.uniform(-0.1, 0.1, (5, 3))
    pixels = CAMERA.project(TRIPOD.inverse().apply(points))
    rows = ["name,x,y,z"]
    picks = ["image,name,u,v"]
    for i, (point, pixel) in enumerate(zip(points, pixels, strict=True)):
        rows.append(f"p{i}," + ",".join(f"{value:.4f}" for value in point))
        picks.append(f"a.png,p{i}," + ",".join(f"{value:.1f}" for value in pixel))
    Path("touched.csv").write_text("\n".join(rows))
    Path("picks.csv").write_text("\n".join(picks))
    write_image("a.png", np.zeros((240, 320, 3), np.uint8))
    return tmp_path


def test_touched_points(run, folder: Path) -> None:
    right = run("verify tripod.json", TOUCHED)
    assert right.code == 0
    assert "5 touched points: within" in right.out
    assert ": honest" in right.out
    assert "p4 in a.png" in right.out
    assert right.out.splitlines()[-1].startswith("next: evercal export tripod.json")
    wrong = run("verify moved.json", TOUCHED)
    assert wrong.code == 1
    assert "not as stated" in wrong.out
    assert "position of the camera" in wrong.out


def test_the_file_keeps_the_result(run, folder: Path) -> None:
    first = run.json("verify tripod.json", TOUCHED)
    run("verify tripod.json", TOUCHED)
    before, after = read_calibration("tripod.json").verifications
    assert before == first
    assert after["created"] >= before["created"]


def test_the_report_shows_the_result(run, folder: Path) -> None:
    run("verify moved.json", TOUCHED)
    run("report moved.json --out r.html")
    page = Path("r.html").read_text("utf-8")
    assert "Independent check" in page
    assert "5 touched points: errors of" in page
    assert "<strong>not as stated</strong>" in page


def test_points_are_picked_in_the_browser(run, folder: Path) -> None:
    rows = [line.split(",") for line in Path("picks.csv").read_text().splitlines()[1:]]
    body = json.dumps([[image, name, float(u), float(v)] for image, name, u, v in rows])
    Path("picks.csv").unlink()
    opened = []
    start = PickServer.wait

    def wait(server: PickServer) -> None:
        opened.append(server.points)
        thread = threading.Thread(target=post, args=(server.url,))
        thread.start()
        start(server)
        thread.join()

    def post(url: str) -> None:
        urllib.request.urlopen(f"{url}picks", body.encode(), 10).close()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PickServer, "wait", wait)
        ran = run("verify tripod.json a.png --pick", TOUCHED)
    assert opened == [[f"p{i}" for i in range(5)]]
    assert ran.code == 0
    assert "pick the points at http://127.0.0.1:" in ran.out
    assert ": honest" in ran.out


def test_gripper_poses_and_a_stated_tool(run, folder: Path) -> None:
    rows = ["name,x,y,z,qw,qx,qy,qz"]
    for line in Path("touched.csv").read_text().splitlines()[1:]:
        name, x, y, z = line.split(",")
        rows.append(f"{name},{x},{y},{float(z) + 0.15},0,1,0,0")
    Path("touches.csv").write_text("\n".join(rows))
    words = "verify tripod.json --picks picks.csv --touches touches.csv"
    assert run(words, "--tool 0,0,0.15").code == 0
    assert "three orientations" in run.refused(words)
    assert "--tool 0,0: give x,y,z" in run.refused(words, "--tool 0,0")


def test_depth_images(run, folder: Path) -> None:
    Path("depth").mkdir()
    assert "depth image is missing" in run.refused(
        "verify tripod.json --depth depth", TOUCHED
    )
    np.save("depth/a.npy", np.full((240, 320), 900.0))
    assert "whole numbers are millimetres" in run.refused(
        "verify tripod.json --depth depth", TOUCHED
    )
    np.save("depth/a.npy", np.full((24, 32), 0.9))
    assert "has shape (24, 32)" in run.refused(
        "verify tripod.json --depth depth", TOUCHED
    )
    np.save("depth/a.npy", np.full((240, 320), 900, np.uint16))
    assert run("verify tripod.json --depth depth", TOUCHED).code in (0, 1)


def test_wrong_input_is_one_line(run, folder: Path) -> None:
    write_image("b.png", np.zeros((480, 640, 3), np.uint8))
    picks = Path("picks.csv").read_text()
    Path("picks.csv").write_text(picks.replace("a.png", "b.png"))
    assert "images are 640x480" in run.refused("verify tripod.json", TOUCHED)
    Path("picks.csv").write_text(picks.replace("p1", "q1"))
    assert "q1 was picked and not touched; touched are p0" in run.refused(
        "verify tripod.json", TOUCHED
    )
    Path("picks.csv").write_text(picks)
    lines = Path("touched.csv").read_text().splitlines()
    scaled = [lines[0]]
    for line in lines[1:]:
        name, *values = line.split(",")
        scaled.append(",".join([name, *(str(1000 * float(value)) for value in values)]))
    Path("touched.csv").write_text("\n".join(scaled))
    assert "a coordinate is 587; points are in metres" in run.refused(
        "verify tripod.json", TOUCHED
    )
    assert read_calibration("tripod.json").verifications == ()


def test_a_camera_on_the_gripper_needs_a_pose_for_each_image(run, folder: Path) -> None:
    gripper = SE3.from_translation([0.4, 0.0, 0.4])
    own = read_calibration("tripod.json")
    mounted = gripper.inverse() @ TRIPOD
    wrist = Calibration("eye_in_hand", mounted, own.covariance, camera=CAMERA)
    wrist.write("wrist.json")
    assert "give the gripper's pose" in run.refused("verify wrist.json", TOUCHED)
    Path("poses.csv").write_text("image,x,y,z,qw,qx,qy,qz\nb.png,0.4,0,0.4,1,0,0,0\n")
    words = ("verify wrist.json --robot-poses poses.csv", TOUCHED)
    assert "poses.csv: names no image" in run.refused(*words)
    Path("poses.csv").write_text("image,x,y,z,qw,qx,qy,qz\na.png,0.4,0,0.4,1,0,0,0\n")
    assert json.loads(run(*words, "--json").out)["verdict"] != "not as stated"
