"""`evercal solve` and `evercal detect`: files in, files out, exit codes."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from benchmarks.hand_eye import Setting, SimulatedPairs, error, recording, rotations
from evercal.calibration.boards.board import BoardKind
from evercal.calibration.calibration import read_calibration
from evercal.errors import with_options
from evercal.geometry import SE3
from evercal.recordings import write_image

from ..calibration.boards.printed import CAMERA, CHESSBOARD, photographed, view_of

BOARD = "--board chessboard --size 9x6 --square-mm 30"


def write_poses(path: Path, poses: SE3) -> None:
    rows = np.concatenate([poses.translation_m, rotations(poses).as_rotvec()], 1)
    header = "x_m,y_m,z_m,rotvec_x,rotvec_y,rotvec_z"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.12g")


def files(folder: Path, simulated: SimulatedPairs) -> list[Any]:
    write_poses(folder / "robot.csv", simulated.pairs.base_from_gripper)
    write_poses(folder / "camera.csv", simulated.pairs.camera_from_board)
    robot = ["--robot-poses", folder / "robot.csv"]
    camera = ["--camera-poses", folder / "camera.csv"]
    return ["solve", *robot, *camera, "--out", folder / "out.json"]


def test_a_calibration_is_written_and_printed(run, tmp_path):
    simulated = recording(Setting(noise_mm=0.5, noise_deg=0.05, outliers=2), 0)
    words = [*files(tmp_path, simulated), "--mount", "eye_in_hand"]
    ran = run(*words)
    assert ran.code == 0
    assert ran.out.startswith("gripper_from_camera: the pose of camera in gripper")
    assert "23 of 25 used" in ran.out
    assert f"rejected   row {simulated.spoiled[0] + 1}: " in ran.out
    assert ran.out.splitlines()[-1].startswith("next: evercal verify")
    calibration = read_calibration(tmp_path / "out.json")
    difference = error(calibration.parent_from_child, simulated.parent_from_camera)
    assert np.linalg.norm(difference[:3]) < 0.001
    assert calibration.source["command"] == "solve"
    record = run.json(*words, "--gripper-frame tool0 --camera-frame optical")
    assert record["matrix"] == calibration.to_dict()["matrix"]
    assert (record["parent_frame"], record["child_frame"]) == ("tool0", "optical")
    assert record["checks"]["poses_used"] == 23


def test_an_unusable_calibration_exits_with_1(run, tmp_path):
    setting = Setting("eye_to_hand", noise_mm=12, noise_deg=1.0, path="table")
    simulated = recording(setting, 1)
    ran = run(*files(tmp_path, simulated), "--mount eye_to_hand")
    assert ran.code == 1
    assert "Unusable" in ran.out


def test_mistakes_are_one_line_and_exit_with_2(run, tmp_path):
    simulated = recording(Setting(), 2)
    words = files(tmp_path, simulated)
    inverted = simulated.pairs.base_from_gripper.inverse()
    write_poses(tmp_path / "robot.csv", inverted)
    assert "--invert robot" in run.refused(*words, "--mount eye_in_hand")
    assert not (tmp_path / "out.json").exists()
    assert run.json(*words, "--mount eye_in_hand").keys() == {"error"}
    # The advice of the message solves it.
    assert run(*words, "--mount eye_in_hand --invert robot").code == 0
    write_poses(tmp_path / "robot.csv", inverted[:20])
    ran = run(*words, "--mount eye_in_hand")
    assert ran.code == 2
    assert "20 poses for 25 images" in ran.err[0]
    assert run(*words, "--mount beside").code == 2
    assert (
        "no.csv: file of camera poses is missing; check --camera-poses"
        in run.refused(
            *words[:3], "--camera-poses", tmp_path / "no.csv", "--mount eye_in_hand"
        )
    )


def test_unknown_scale_is_estimated_on_request(run, tmp_path):
    simulated = recording(Setting(scale=0.37), 3)
    words = [*files(tmp_path, simulated), "--mount", "eye_in_hand"]
    assert run(*words).code == 2
    ran = run(*words, "--scale unknown --json")
    assert ran.code == 0
    assert ran.json["checks"]["scale"] == pytest.approx(0.37, rel=0.005)


def test_time_offset_requires_times(run, tmp_path):
    words = files(tmp_path, recording(Setting(), 5))
    ran = run(*words, "--mount eye_in_hand --time-offset")
    assert ran.code == 2
    assert "column stamp_s" in ran.err[0]


def photographs(folder: Path, count: int) -> tuple[list[Path], SE3]:
    """Write images of a board and the gripper poses; return paths and gripper_from_camera."""
    views = SE3.stack([view_of(CHESSBOARD, seed) for seed in range(count)])
    gripper_from_camera = SE3.exp([0.05, -0.02, 0.08, 0.1, 0.3, 1.5])
    base_from_board = SE3.exp([0.5, 0.1, 0.0, 3.0, 0.2, 0.1])
    robot = base_from_board @ (gripper_from_camera @ views).inverse()
    write_poses(folder / "robot.csv", robot)
    paths = []
    for i, view in enumerate(views):
        paths.append(folder / f"image-{i + 1}.png")
        write_image(paths[-1], photographed(CHESSBOARD, view, i))
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_dict()))
    return paths, gripper_from_camera


def test_from_photographs_to_a_calibration(run, tmp_path):
    paths, truth = photographs(tmp_path, 11)
    out = tmp_path / "board.json"
    # Sorted like in a shell: image-10 before image-2.
    ran = run(
        "detect",
        *sorted(paths),
        BOARD,
        "--camera",
        tmp_path / "camera.json",
        "--out",
        out,
    )
    assert ran.code == 0
    assert "11 of 11 images show the board" in ran.out
    words = ["solve", "--robot-poses", tmp_path / "robot.csv", "--camera-poses", out]
    solved = run(*words, "--mount eye_in_hand --out", tmp_path / "out.json")
    assert solved.code == 0, solved
    calibration = read_calibration(tmp_path / "out.json")
    difference = error(calibration.parent_from_child, truth)
    assert np.linalg.norm(difference[:3]) < 0.0005
    assert np.linalg.norm(difference[3:]) < np.deg2rad(0.1)
    assert calibration.camera is not None
    assert calibration.camera.fx == pytest.approx(CAMERA.fx, rel=1e-3)
    assert calibration.checks.to_dict()["corner_sigma_px"] < 0.1


def test_detect_reports_images_without_a_board(run, tmp_path):
    paths, truth = photographs(tmp_path, 9)
    write_image(paths[3], np.full((480, 640, 3), 90, np.uint8))
    paths[0].write_bytes(b"")
    out = tmp_path / "board.json"
    ran = run("detect", *paths, BOARD, "--out", out, "--json")
    assert ran.code == 0
    record = ran.json
    assert record == json.loads(with_options(out.read_text()))
    assert record["camera_from"] == "board"
    assert record["camera"]["fx"] == pytest.approx(600, abs=6)
    reasons = [i["reason"] for i in record["images"] if i["camera_from_board"] is None]
    assert reasons == [record["images"][0]["reason"], record["images"][3]["reason"]]
    assert reasons[0].startswith("not a readable image (0 bytes)")
    assert "no chessboard with 9x6 inner corners" in reasons[1]
    # The robot poses of these images are skipped.
    words = ["solve", "--robot-poses", tmp_path / "robot.csv", "--camera-poses", out]
    assert run(*words, "--mount eye_in_hand --out", tmp_path / "out.json").code == 0
    calibration = read_calibration(tmp_path / "out.json")
    assert len(calibration.images) == 7
    assert np.linalg.norm(error(calibration.parent_from_child, truth)[:3]) < 0.005


def test_detect_refuses_unusable_input(run, tmp_path):
    paths, _ = photographs(tmp_path, 1)
    small = tmp_path / "small.json"
    bad = tmp_path / "bad.json"
    cut = tmp_path / "cut.png"
    bad.write_text("{}")
    cut.write_bytes(b"")
    small.write_text(json.dumps({**CAMERA.to_dict(), "width": 320, "height": 240}))
    for words, reason in (
        ([paths[0], BOARD.replace("--size 9x6", "")], "size of 3x3 to 200x200"),
        ([paths[0], "--board chessboard --size 9x6"], "--square-mm"),
        ([paths[0], BOARD.replace("9x6", "9_by_6")], "9x6"),
        ([tmp_path / "no.png", BOARD], "missing"),
        ([cut, BOARD], "cut.png: not a readable image"),
        ([paths[0], BOARD], "intrinsics take at least 5"),
        ([paths[0], BOARD, "--camera", small], "320x240"),
        ([paths[0], BOARD, "--camera", bad], "bad.json"),
        ([paths[0], paths[0], BOARD], "comes twice; give each image a unique name"),
    ):
        ran = run("detect", *words, "--out", tmp_path / "board.json")
        assert ran.code == 2, words
        assert reason in ran.err[-1], ran.err


def test_boards_on_the_page_of_formats_are_printed_but_grids(run, tmp_path):
    page = Path(__file__).parents[2] / "docs" / "formats.md"
    boards = re.findall(
        r"^    evercal detect images/ (--board (\w+) .*)$", page.read_text(), re.M
    )
    assert {kind for _, kind in boards} == set(get_args(BoardKind))
    printed = ["--make-board", tmp_path / "board.png"]
    for words, _ in boards:
        done = run("detect", words, *printed, "--paper a3")
        if "grid" in words:
            assert "take the print of Kalibr or OpenCV" in done.err[0]
        else:
            assert done.code == 0
    other = "--board charuco --size 7,5 --square-mm 30 --marker-mm 20 --dictionary DICT_4X4_50"
    board = run.json("detect", other, *printed)["board"]
    assert (board["columns"], board["rows"], board["dictionary"]) == (7, 5, "4X4_50")


def test_report_finds_the_images_of_detect(run, tmp_path):
    for folder in ("images", "poses", "results"):
        (tmp_path / folder).mkdir()
    photographs(tmp_path / "images", 7)
    poses = tmp_path / "poses" / "board.json"
    out = tmp_path / "results" / "calibration.json"
    camera = tmp_path / "images" / "camera.json"
    robot = tmp_path / "images" / "robot.csv"
    assert (
        run(
            "detect", tmp_path / "images", BOARD, "--camera", camera, "--out", poses
        ).code
        == 0
    )
    names = [image["name"] for image in json.loads(poses.read_text())["images"]]
    assert names[0] == "../images/image-1.png"
    words = ["--robot-poses", robot, "--camera-poses", poses, "--mount", "eye_in_hand"]
    assert run("solve", *words, "--out", out).code == 0
    assert read_calibration(out).images[0].name == "../images/image-1.png"
    page = tmp_path / "page.html"
    pictures = run.json("report", out, "--out", page)["pictures"]
    assert len(pictures) > 0


def test_poses_of_easy_handeye_before_a_fixed_camera_lead_to_it(run, tmp_path):
    """Each refusal or warning names options that bring base_from_camera at last."""
    simulated = recording(Setting("eye_to_hand", path="table"), 1)
    pairs = simulated.pairs
    inverse = replace(pairs, base_from_gripper=pairs.base_from_gripper.inverse())
    words = files(tmp_path, replace(simulated, pairs=inverse))
    samples = []
    for p in inverse.base_from_gripper:
        row = {"translation": axes(p.translation_m), "rotation": axes(p.rotation_wxyz)}
        samples.append({"robot": row})
    record = {"parameters": {"eye_on_hand": False}, "samples": samples}
    (tmp_path / "robot.yaml").write_text(json.dumps(record))
    on_hand = "--mount eye_in_hand"
    fixed = "--mount eye_to_hand"
    yaml = [*words[:2], tmp_path / "robot.yaml", *words[3:]]
    twice = "--invert robot --robot-convention ur:inverse"
    assert "use --mount eye_to_hand and --invert robot" in run(*words, on_hand).out
    for refused, message in (
        ([*words, fixed], "(gripper_from_base): invert them (--invert robot)"),
        ([*words, fixed, twice], "if --invert or :inverse is given, leave it out"),
        ([*words, on_hand, "--invert robot"], "looks wrong: use --mount eye_to_hand"),
        (
            [*yaml, fixed, "--invert robot"],
            "(eye_to_hand); give --robot-convention wxyz:inverse in place of --invert",
        ),
    ):
        assert message in run(*refused).err[-1]
    for solving in (
        [*words, fixed, "--invert robot"],
        [*yaml, fixed, "--robot-convention wxyz:inverse"],
    ):
        assert "warning" not in run(*solving).out
        found = read_calibration(tmp_path / "out.json")
        assert found.parent_frame == "base"
        difference = error(found.parent_from_child, simulated.parent_from_camera)
        assert np.linalg.norm(difference) < 0.03


def axes(values: np.ndarray) -> dict[str, float]:
    return dict(zip("wxyz"[-len(values) :], values.tolist(), strict=True))
