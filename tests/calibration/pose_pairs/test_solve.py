"""`solve`: accuracy, covariance, outliers, scale and real recordings."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import Setting, error, recording, trials
from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import find_board
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.calibration.calibration import Calibration
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import (
    BoardCorners,
    solve,
    solve_pose_pairs,
)
from evercal.evaluation import share_inside
from evercal.geometry import SE3, Camera, average_poses, pose_distance
from evercal.recordings import read_image
from evercal.robot.mount import MountName

MOUNTS: tuple[MountName, ...] = ("eye_in_hand", "eye_to_hand")
EXACT = Setting(noise_mm=0, noise_deg=0)


def largest_error(calibration: Calibration, truth: SE3) -> float:
    return float(np.abs(error(calibration.parent_from_child, truth)).max())


@settings(max_examples=6)
@given(
    st.sampled_from(MOUNTS),
    st.integers(0, 10**6),
    st.sampled_from(["random", "table"]),
    st.sampled_from([None, 0.01, 3.0]),
)
def test_exact_poses_give_the_exact_calibration(
    mount: MountName, seed: int, path: str, scale: float | None
) -> None:
    truth = recording(replace(EXACT, mount=mount, path=path, scale=scale), seed)
    calibration = solve(truth.pairs, mount, scale is None)
    assert largest_error(calibration, truth.parent_from_camera) < 1e-6
    assert calibration.parent_frame == ("gripper" if mount == "eye_in_hand" else "base")
    assert all(image.used for image in calibration.images)
    if scale is not None:
        assert calibration.checks.to_dict()["scale"] == pytest.approx(scale, rel=1e-6)


@pytest.mark.parametrize("setting", [Setting(), Setting("eye_to_hand", outliers=3)])
def test_errors_lie_inside_the_covariance(setting: Setting) -> None:
    # The benchmark runs a thousand trials; these few detect a broken covariance.
    result = trials(setting, 14, 100)
    assert result["median mm"] < 1.4
    assert result["median deg"] < 0.1
    assert result["largest mm"] < 6
    assert result["inside 95 %"] > 80
    assert result["outliers exactly"] >= 95


def test_the_covariance_is_not_too_large() -> None:
    distances = []
    for seed in range(24):
        truth = recording(Setting(noisy="both"), 200 + seed)
        result = solve(truth.pairs, "eye_in_hand")
        distances.append(
            result.uncertain_pose.squared_mahalanobis(truth.parent_from_camera)
        )
    # Chi-square with six degrees of freedom has mean 6 and median 5.35.
    assert 4.2 < np.mean(distances) < 8.5
    assert 0.25 < np.mean(np.array(distances) < 5.35) < 0.75
    assert share_inside(distances) > 80


def test_outliers_are_named_in_any_order() -> None:
    truth = recording(Setting("eye_to_hand", outliers=9), 3)
    first = solve(truth.pairs, "eye_to_hand")
    outliers = {i for i, image in enumerate(first.images) if not image.used}
    assert outliers == set(truth.spoiled)
    for i in outliers:
        image = first.images[i]
        assert "disagrees with the others by" in image.reason
        assert image.residual_mm is not None
        assert 20 < image.residual_mm < 120
        assert image.residual_deg == pytest.approx(20, abs=2)
    order = np.random.default_rng(0).permutation(25)
    second = solve(truth.pairs[order], "eye_to_hand")
    # Drift depends on the order, and nothing else.
    assert second.uncertain_pose.squared_mahalanobis(first.parent_from_child) < 1
    left_out = [image.name for image in second.images if not image.used]
    assert sorted(left_out) == sorted(truth.pairs.names[i] for i in outliers)
    assert [image.name for image in second.images] == [
        truth.pairs.names[i] for i in order
    ]


def test_repeated_pairs_do_not_change_the_covariance() -> None:
    pairs = recording(Setting(), 4).pairs
    repeated = pairs[np.concatenate([np.arange(25), np.arange(10)])]
    repeated = replace(repeated, names=tuple(f"image {i}" for i in range(35)))
    once = solve(pairs, "eye_in_hand")
    twice = solve(repeated, "eye_in_hand")
    assert np.allclose(twice.covariance, once.covariance, rtol=1e-9)
    assert [image.used for image in twice.images] == [True] * 25 + [False] * 10
    assert twice.images[30].reason == "repeats image 5, which adds nothing"


def test_checks_and_error_terms_match_the_noise() -> None:
    truth = recording(Setting(noise_mm=1.0, noise_deg=0.05, path="table"), 5)
    calibration = solve(truth.pairs, "eye_in_hand")
    checks = calibration.checks.to_dict()
    # A held-out pose differs by its own noise along three axes, and a little more.
    assert 1.2 < checks["held_out_mm"] < 3.0
    assert 1.4 < checks["residual_mm"] < 2.4
    assert checks["poses_used"] == 25
    assert checks["warnings"] == []
    board = SE3(
        checks["base_from_board"]["quaternion_wxyz"],
        checks["base_from_board"]["translation_m"],
    )
    assert pose_distance(board, truth.fixed_from_board)[0] < 0.003
    squared = sum(term.translation_mm**2 for term in calibration.error_terms)
    assert np.sqrt(squared) == pytest.approx(calibration.sigma_mm, rel=0.02)


@pytest.mark.parametrize(
    ("what", "row"), [("camera", 4), ("board", 12), ("camera", 23)]
)
def test_a_slip_is_named_and_widens_the_covariance(what: str, row: int) -> None:
    mount: MountName = "eye_in_hand" if row == 4 else "eye_to_hand"
    truth = recording(Setting(mount, path="table", noise_mm=0.3, noise_deg=0.03), 8)
    step = SE3.exp([0.002, 0.003, -0.004, 0.004, 0.0, 0.006])
    pairs = truth.pairs
    camera = list(pairs.camera_from_board)
    moved = [step.inverse() @ p if what == "camera" else p @ step for p in camera[row:]]
    slipped = replace(pairs, camera_from_board=SE3.stack([*camera[:row], *moved]))
    calibration = solve(slipped, mount)
    [warning] = calibration.checks.to_dict()["warnings"]
    assert re.search(
        rf"the {what} looks moved by \d\.\d mm .* before row {row + 1},", warning
    )
    after = (
        truth.parent_from_camera @ step
        if what == "camera"
        else truth.parent_from_camera
    )
    for pose in (truth.parent_from_camera, after):
        assert calibration.uncertain_pose.squared_mahalanobis(pose) < 16.8
    assert solve(pairs, mount).checks.to_dict()["warnings"] == []


def test_lengths_are_stated_in_metres_unless_said_otherwise() -> None:
    """A board that is stated can be off by 0.2 %, and so can its depth in all images."""
    pairs = recording(Setting(), 4).pairs
    default = solve_pose_pairs(pairs, "eye_in_hand")
    stated = solve(pairs, "eye_in_hand", scale_known=True)
    np.testing.assert_array_equal(default.calibration().covariance, stated.covariance)
    for scale_known, of_board, names in (
        (True, True, {"shared depth", "size"}),
        (False, True, {"size"}),
        (True, False, {"size"}),
    ):
        found = solve_pose_pairs(pairs, "eye_in_hand", scale_known, of_board=of_board)
        assert {*found.equation.extras.names} == names


@pytest.mark.parametrize(
    ("camera_m", "board_m", "warned"),
    [(1.0, 0.3, False), (1.0, 0.22, True), (0.35, 0.05, False), (0.45, 0.05, True)],
)
def test_a_camera_far_from_its_gripper_may_have_the_other_mount(
    camera_m: float, board_m: float, warned: bool
) -> None:
    """It is doubted at 0.4 m, and four times as far as the board is from the base."""
    truth = recording(EXACT, 0)
    pairs = truth.pairs
    carried = SE3(truth.parent_from_camera.rotation_wxyz, np.array([0, 0, camera_m]))
    board = SE3(truth.fixed_from_board.rotation_wxyz, np.array([board_m, 0, 0]))
    seen = (pairs.base_from_gripper @ carried).inverse() @ board
    solved = solve(replace(pairs, camera_from_board=seen), "eye_in_hand")
    warnings = solved.checks.to_dict()["warnings"]
    assert any("if it is the other way round" in words for words in warnings) == warned


REAL = Path(os.environ.get("EVERCAL_REAL_DATA", "")) / "handeye"
FRANKA = Camera(640, 480, 607.593, 607.575, 323.463, 243.255)


@pytest.mark.skipif(
    not REAL.is_dir(), reason="EVERCAL_REAL_DATA names no real recordings"
)
@pytest.mark.parametrize(
    ("name", "board", "camera", "published_m", "apart_mm"),
    [
        (
            "franka_eye_in_hand",
            Board("chessboard", 0.0236, 9, 6),
            FRANKA,
            (0.0579, -0.0341, -0.0424),
            4.5,
        ),
        (
            "franka_eye_to_hand",
            Board("apriltag", 0.048, dictionary="APRILTAG_36h11"),
            FRANKA,
            None,
            4.5,
        ),
        pytest.param(
            "kuka_eye_in_hand",
            Board("chessboard", 0.015, 24, 17),
            None,
            (0.014, -0.108, -0.082),
            0.8,
            marks=pytest.mark.slow(
                "src/evercal/calibration/pose_pairs", "src/evercal/calibration/boards"
            ),
        ),
    ],
)
def test_real_recordings(
    name: str,
    board: Board,
    camera: Camera | None,
    published_m: tuple[float, float, float] | None,
    apart_mm: float,
) -> None:
    """The board stays where it is, and the camera is where it was published."""
    rows = np.loadtxt(REAL / name / "base_from_gripper.csv", delimiter=",", skiprows=1)
    robot = SE3(
        Rotation.from_rotvec(rows[:, 3:]).as_quat(scalar_first=True), rows[:, :3]
    )
    images = {
        path.name: read_image(path) for path in sorted((REAL / name).glob("image-*"))
    }
    detected = {file: find_board(image, board) for file, image in images.items()}
    views = tuple(view for view in detected.values() if isinstance(view, BoardView))
    assert len(views) == len(images)
    stated = camera is not None
    if camera is None:
        height, width = next(iter(images.values())).shape[:2]
        camera = calibrate_camera(views, width, height).camera
    poses = board_poses(board, camera, detected)
    boards = SE3.stack(
        [i.camera_from_board for i in poses.images if i.camera_from_board]
    )
    mount: MountName = "eye_in_hand" if name.endswith("in_hand") else "eye_to_hand"
    corners = BoardCorners(camera, views, stated=stated)
    solved = solve(PosePairs(tuple(images), robot, boards), mount, corners=corners)
    fixed_from_parent = robot if mount == "eye_in_hand" else robot.inverse()
    sized = SE3(
        boards.rotation_wxyz, solved.checks.to_dict()["scale"] * boards.translation_m
    )
    fixed = fixed_from_parent @ solved.parent_from_child @ sized
    assert np.median(pose_distance(average_poses(fixed), fixed)[0]) < apart_mm / 1000
    if published_m is not None:
        assert (
            np.linalg.norm(solved.parent_from_child.translation_m - published_m) < 0.003
        )
