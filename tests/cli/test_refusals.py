"""Bad input of every verb is one line that names the thing, exit code 2, and nothing written."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.geometry import SE3, Camera
from evercal.recordings import write_image

PACKAGES = {"serve": "fastapi", "view": "viser", "studio": "viser"}
STRANGER = "holds networks of strategy finetune, and this needs a map"

REFUSED = {
    "align MAP hall": "either images with --robot-poses, --points or --distance",
    "align MAP hall --points p.csv": "--picks with either --points or --distance",
    "align NETWORKS box-room-41 image.png --robot-poses poses.csv": "holds networks of strategy",
    "audit MAP empty": "empty",
    "audit MAP empty --images 0": "--images is at least 1",
    "bench attic": "suite 'attic': unknown; choose one of sim-mini",
    "bench empty": "no complete run",
    "bench custom ROOM --poses colour": "--poses: not used by recordings of format generic",
    "bench custom": "suite custom: give scene folders for the suite custom only",
    "bench sim-mini somewhere": "suite sim-mini: give scene folders for the suite custom",
    "bench sim-mini --strategies evercal,magic": "strategy 'magic': unknown; choose one of",
    "bench sim-mini --seeds 0,one": "--seeds 0,one: give comma-separated numbers",
    "bench sim-mini --seeds ,": "--seeds ,: give comma-separated numbers",
    "bench sim-mini --steps 0": "--steps 0: give a number >= 1",
    "bench sim-mini --batch 63": "--batch 63: give a number >= 64",
    "bench sim-mini --memory all": "--memory all: give a share",
    "bench sim-mini --scenes bedroom": "two or more",
    "bench real2": "--data",
    "calibrate MAP": "no image given",
    "calibrate MAP none.png": "none.png: image file is missing",
    "calibrate MAP empty": "no images in this folder",
    "calibrate MAP image.png --mount eye_in_hand": "--robot-poses",
    "calibrate MAP a=image.png image.png": "cannot be mixed",
    "calibrate MAP a=image.png --mount eye_in_hand": "cameras of a rig are fixed",
    "calibrate MAP black.png": "0 of 1 images were located",
    "calibrate NETWORKS image.png": STRANGER,
    "check MAP image.png --reference none.json": "calibration file is missing",
    "check MAP empty --reference none.json": "calibration file is missing",
    "evaluate MAP": "no scene given",
    "evaluate MAP none": "none: no such folder",
    "evaluate MAP ROOM": "scene 'box-room-42' is not in the store",
    "evaluate ROOM ROOM": "is not a",
    "export c.json": "no format given; add --format NAME, one of easy_handeye2",
    "export --format urdf": "no calibration given",
    "export none.json --format urdf": "missing",
    "export hand.json --format nerfstudio": "intrinsics are required",
    "export c.json --format xml": "'xml' is not known; use one of easy_handeye2",
    "export c.json --format urdf --child /camera": "'/camera' is no name of a tf frame",
    "export c.json --format urdf --parent base --child base": "both called 'base'",
    "export c.json --format urdf --via camera_link": "--via-optical if their origins are",
    "export c.json --format urdf --via-optical": "name the driver's root frame with --via",
    "export c.json --format urdf --via l --via-optical --via-offset 1 0 0": "give one of --via-tr",
    "export c.json --format urdf --via l --via-transform no.yaml": "no.yaml: ",
    "export c.json --format urdf --parent base --via base --via-optical": "both called 'base'",
    "export c.json --format colmap --via l --via-optical": "omit --via",
    "export c.json --format tum --robot-poses no.csv": "no.csv: file of robot poses is missing",
    "export c.json --format moveit_samples": "--target-poses",
    "info empty": "empty",
    "info none": "none: no such folder",
    "info --check none": "none: no such folder",
    "inspect empty": "empty",
    "inspect file": "a file, not a folder",
    "inspect ROOM --format x": "format 'x' is not known",
    "inspect ROOM --coverage": "gripper poses",
    "learn MAP": "no RECORDING given",
    "learn MAP none": "none: no such folder",
    "learn MAP ROOM --strategy finetune": "was made with evercal",
    "learn MAP ROOM --memory lots": "--memory lots",
    "learn MAP ROOM --memory 0%": "--memory 0%",
    "learn MAP ROOM --centres 5": "--centres 5: a map is not trained",
    "learn MAP ROOM --preset paper": "--preset paper: a map is not trained",
    "learn MAP ROOM --device cpu": "--device cpu: a map is not trained",
    "learn MAP ROOM --weight 3": "--weight 3.0: a map is not trained",
    "learn MAP ROOM --encoder none.onnx": "no such file",
    "learn MAP ROOM --encoder file": "keeps the encoder",
    "learn MAP ROOM --format png": "generic, 7scenes",
    "learn MAP ROOM --format 7scenes": "TrainSplit.txt",
    "learn MAP ROOM --name hall": "a scene of this name",
    "learn MAP ROOM --name a/b": "scene name",
    "learn MAP ROOM --name=": "scene name",
    "learn MAP ROOM --calibration c.json": "states camera poses",
    "learn MAP ROOM --gripper-from-camera c.json": "states camera poses",
    "learn MAP ROOM --ray auto --workers 3": "--workers 3: --ray has its own",
    "learn MAP s3://bucket/room --name x": "--name x: is for one recording, without --ray",
    "learn MAP ROOM ROOM --name x": "--name x: is for one recording, without --ray",
    "learn NETWORKS ROOM --strategy er": "was made with finetune",
    "learn NETWORKS ROOM --centres 7": "was made with another one",
    "learn NETWORKS ROOM --offsets shared": "was made with another one",
    "learn NETWORKS ROOM --backbone paper": "was made with another one",
    "learn NETWORKS ROOM --base arm1": "--base arm1: is for a map",
    "learn NETWORKS ROOM --replace old": "--replace old: is for a map",
    "learn NETWORKS ROOM --centres 0": "--centres 0: give a number >= 1",
    "learn NETWORKS ROOM --steps 0": "--steps 0: give a number >= 1",
    "learn NETWORKS ROOM --batch 8": "--batch 8: give a number >= 64",
    "learn NETWORKS ROOM --weight 3": "--weight 3.0: strategy 'finetune' protects no scene",
    "learn NETWORKS ROOM --plugin none.py": "none.py: not a Python file",
    "learn NETWORKS ROOM --seed -1": "--seed -1: give a number >= 0",
    "learn NETWORKS ROOM --memory auto": "memory auto",
    "learn NETWORKS ROOM --name box-room-41": "a scene of this name exists",
    "learn new ROOM --strategy joint": "does not train a network scene by scene",
    "learn new ROOM --strategy nonsense": "finetune",
    "localize MAP image.png none.png": "none.png: image file is missing",
    "localize MAP": "no image given",
    "localize MAP image.png --device cuda": "--device cuda: a map needs no device",
    "localize MAP image.png --camera broken.png": "broken.png",
    "localize MAP image.png --camera tall.json": "240x320",
    "localize MAP image.png --overlay broken.png": "--overlay broken.png",
    "localize MAP image.png --video a.avi": "a.avi",
    "localize empty image.png": "empty",
    "localize MAP empty": "no images in this folder",
    "map list none": "none: no such folder",
    "map remove MAP attic": "has no scene of this name",
    "map remove MAP": "no scene given",
    "map merge MAP": "no map given",
    "map rename MAP hall .x": "scene name '.x'",
    "map rename none hall x": "none: no such folder",
    "map merge MAP MAP": "is the map that scenes are merged into",
    "map merge none none": "none: no such folder",
    "map pack MAP none/x.zip": "FILE none/x.zip: folder ",
    "map pack none x.zip": "none: no such folder",
    "map unpack none new": "none: no such file",
    "map unpack c.json new": "not a zip archive",
    "map unpack c.json images": "images: exists; give a new folder",
    "refresh MAP": "give images of the changed room, or --undo SCENE",
    "refresh MAP image.png --undo hall": "give images of the changed room, or --undo SCENE",
    "refresh MAP --undo attic": "scene 'attic'",
    "refresh MAP empty": "image",
    "report none.json": "calibration file is missing",
    "report c.json --against none.json": "calibration file is missing",
    "report c.json --images none.png": "image file is missing",
    "report c.json --store none": "none",
    "report c.json --against hand.json": "same mount",
    "serve MAP --host 0.0.0.0": "--host 0.0.0.0: other machines could use the map; give --token-",
    "serve MAP --token-file MISSING": "--token-file MISSING: ",
    "serve MAP --port 99999": "--port 99999: give 0 to 65535",
    "serve images --port 0": "is not an evercal store",
    "simulate cell --out x --size 640": "640x480",
    "simulate cell --out x --size 20x20": "at least 64x64",
    "simulate cell --out x --frames 0": "at least 1",
    "simulate cell --out x --seed 9000": "reserved",
    "studio": "no --camera SOURCE given",
    "studio --camera 0": "no --poses FILE given",
    "studio --camera none --poses p.csv": "none: no such folder or video",
    "studio --camera images --poses p.csv": "no --intrinsics FILE given",
    "studio --virtual --camera 0": "--camera: the virtual cell has its own",
    "studio --virtual --most-age 5": "--most-age: the virtual cell has its own",
    "studio --virtual --fixed-intrinsics c.json": "--fixed-intrinsics: is of --fixed",
    "studio --virtual --seed 9000": "seed 9000",
    "track MAP none": "no such folder or video",
    "track MAP images --out t.bin": "ends with .jsonl",
    "track MAP images --rate 0": "above 0",
    "verify none.json": "calibration file is missing",
    "verify c.json": "give --picks, --board-poses, or images with the --store",
    "verify c.json image.png": "give --picks, --board-poses, or images with the --store",
    "verify c.json --picks none.csv": "none.csv: table of points is missing",
    "verify c.json --picks picks.csv": "give --points or --touches of these points",
    "verify c.json --picks picks.csv --points picks.csv": "expected name, x, y, z, got 'image.png",
    "verify c.json --picks unnamed.csv": "unnamed.csv: expected image, name, u, v, got 'image.pn",
    "verify c.json --board-poses none.json": "file of camera poses is missing",
    "verify c.json image.png --store MAP": "1 image with the target; give two or more",
    "view MAP --port 99999": "--port 99999: give 0 to 65535",
    "view MAP none.json": "none.json: calibration file is missing",
    "view MAP --camera c.json": "--camera: is that of --live, which is missing",
    "view MAP --live none.mp4": "none.mp4: no such folder or video",
    "view empty": "no manifest.json in it, so it is not a store",
    "view NETWORKS": STRANGER,
    "watch MAP none --reference c.json": "none: no such folder",
    "watch MAP images --reference c.json --window 0": "--window is at least 1",
    "watch MAP images --reference none.json": "calibration file is missing",
    "watch MAP images --reference c.json --idle 9 --camera none.txt": "camera file is missing",
    "watch MAP images --reference c.json --idle 9 --camera short.txt": "short.txt",
}
for _verb in ("localize MAP image.png", "calibrate MAP image.png", "report c.json"):
    for _text in ("0,1", "a,b,c", "0,0,nan", "0,0,1,2"):
        REFUSED[f"{_verb} --at={_text}"] = (
            f"--at {_text}: give x,y,z in metres such as 0,0.05,0.4"
        )


@pytest.fixture
def folder(tmp_path, hall, monkeypatch) -> Path:
    """The working folder with what the commands name."""
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("images").mkdir()
    for name in ("image.png", "images/0.png"):
        write_image(name, hall.test[7].read_image())
    write_image("black.png", np.zeros((240, 320, 3), np.uint8))
    Path("broken.png").write_bytes(b"\x89PNG broken")
    Path("file").write_text("x")
    Path("short.txt").write_text("300 0 160")
    Path("poses.csv").write_text("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n")
    Path("picks.csv").write_text("image.png,a,1,2\n")
    Path("unnamed.csv").write_text("image,name,u,v\nimage.png,,1,2\n")
    Path("tall.json").write_text(
        json.dumps(Camera(240, 320, 250, 250, 119.5, 159.5).to_dict())
    )
    pose = SE3.exp([0.1, 0.05, 1.0, 3.1, 0, 0])
    spread = 1e-8 * np.eye(6)
    images = (ImageUse("image.png", True, "", 0.5, 0.01),)
    camera = hall.test[7].camera
    Calibration("eye_to_hand", pose, spread, camera=camera, images=images).write(
        "c.json"
    )
    Calibration("eye_in_hand", pose, spread).write("hand.json")
    return tmp_path


@pytest.fixture
def paths(hall_store, rooms, request, words) -> dict[str, Path]:
    """Paths that words of a command stand for."""
    paths = {"MAP": hall_store, "ROOM": rooms[1]}
    if "NETWORKS" in words:
        paths["NETWORKS"] = request.getfixturevalue("network_store")
    return paths


@pytest.mark.parametrize("words", REFUSED)
def test_bad_input_is_one_line_and_writes_nothing(run, folder, paths, snapshot, words):
    package = PACKAGES.get(words.split()[0])
    if package:
        pytest.importorskip(package)
    stores = {name: snapshot(path) for name, path in paths.items()}
    before = snapshot(folder)
    ran = run(*(paths.get(word, word) for word in words.split()), "--json")
    (line,) = ran.err
    assert ran.code == 2
    assert REFUSED[words] in line
    assert line == f"error: {ran.json['error']}"
    assert ran.json.keys() == {"error"}
    after = {name: snapshot(path) for name, path in paths.items()}
    for state in (before, *stores.values(), *after.values()):
        for name in [name for name in state if name.endswith(".lock")]:
            del state[name]
    assert snapshot(folder) == before
    assert after == stores


BOARD = "detect --board chessboard --size 9x6 --square-mm 25"


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("words", "package", "extra"),
    [
        ("serve MAP", "evercal.service.server", "serve"),
        ("view MAP", "viser", "view"),
        (f"{BOARD} --make-board b.pdf", "PIL.Image", "boards"),
        ("studio --virtual --out s", "viser", "view"),
    ],
)
def test_a_missing_package_is_named(run, paths, monkeypatch, words, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    refusal = run.refused(*(paths.get(word, word) for word in words.split()))
    assert re.search(r" needs [\w.]+; in the checkout of evercal, run: ", refusal)
    assert f"constraints.txt '.[{extra}]'" in refusal


def test_limits_hold_for_files_and_for_opencv(tmp_path):
    """In a process of its own: OpenCV reads its limit once, when it is loaded."""
    write_image(tmp_path / "a.png", np.zeros((40, 50, 3), np.uint8))
    command = [sys.executable, "-m", "evercal", "detect", str(tmp_path / "a.png")]
    command += ["--board", "chessboard", "--size", "9x6", "--square-mm", "25"]
    clean = {k: v for k, v in os.environ.items() if not k.startswith("OPENCV")}
    ends = []
    for limits in ("pixels=1999", "pixels=2e3"):
        words = [*command, "--limits", limits, "--out", str(tmp_path / "found.json")]
        ends.append(
            subprocess.run(words, capture_output=True, text=True, env=clean).stderr
        )
    assert "a.png (50x40): 2,000 pixels, at most 1,999 are read" in ends[0]
    assert "a.png (" not in ends[1]
