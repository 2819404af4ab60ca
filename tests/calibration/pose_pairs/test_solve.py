"""`solve`: accuracy, covariance, outliers, scale, board corners and real recordings."""

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.board_recordings import (
    BoardRecording,
    BoardSetting,
    corner_pairs,
    project,
    record,
)
from benchmarks.hand_eye import Setting, error, recording, trials
from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView, board_pose
from evercal.calibration.boards.detection import find_board
from evercal.calibration.boards.intrinsics import calibrate_camera
from evercal.calibration.calibration import Calibration
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import BoardCorners, solve
from evercal.evaluation import share_inside
from evercal.geometry import SE3, Camera, average_poses, pose_distance
from evercal.recordings import read_image
from evercal.robot.mount import MountName

from ..boards.printed import grid

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
    difference = second.parent_from_child.matrix() - first.parent_from_child.matrix()
    assert np.abs(difference).max() < 1e-12
    assert np.allclose(second.covariance, first.covariance, rtol=1e-9)
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


class Photographed(NamedTuple):
    """A simulated recording of a chessboard."""

    pairs: PosePairs
    parent_from_camera: SE3
    camera: Camera

    def views(
        self, points: np.ndarray, noise_px: float, seed: int
    ) -> tuple[BoardView, ...]:
        rng = np.random.default_rng(seed)
        exact = [
            self.camera.project(pose.apply(points))
            for pose in self.pairs.camera_from_board
        ]
        return tuple(
            BoardView(points, p + rng.normal(0, noise_px, p.shape)) for p in exact
        )


def photographed(mount: MountName, seed: int, robot_deg: float = 0.0) -> Photographed:
    """Simulate exact camera poses, and robot poses with rotation noise."""
    rng = np.random.default_rng(seed)
    camera = Camera(1280, 960, 1000, 1000, 640, 480, (-0.1, 0.05, 0.001, 0.0))
    n = 20
    rotation = Rotation.from_rotvec(rng.normal(0, 0.35, (n, 3)))
    centre = rotation.apply(np.tile([0.12, 0.075, 0], (n, 1)))
    translation = np.array([0, 0, 0.6]) + rng.normal(0, 0.06, (n, 3)) - centre
    board = SE3(rotation.as_quat(scalar_first=True), translation)
    parent_from_camera = SE3.exp([0.05, -0.1, 0.08, 0.3, 0.2, -1.5])
    robot = (
        SE3.exp([0.5, 0.1, 0.2, 2.0, 1.0, 0.1]) @ (parent_from_camera @ board).inverse()
    )
    robot = robot if mount == "eye_in_hand" else robot.inverse()
    noise = rng.normal(0, np.deg2rad(robot_deg) + 1e-12, (n, 3))
    robot = robot @ SE3.exp(np.concatenate([np.zeros((n, 3)), noise], 1))
    pairs = PosePairs(tuple(f"{i}.png" for i in range(n)), robot, board)
    return Photographed(pairs, parent_from_camera, camera)


@pytest.mark.parametrize(
    ("mount", "noise_px", "robot_deg"),
    [("eye_in_hand", 0.3, 0.0), ("eye_to_hand", 0.1, 0.1)],
)
def test_corners_improve_the_calibration(
    mount: MountName, noise_px: float, robot_deg: float
) -> None:
    distances = []
    with_corners = []
    without = []
    for seed in range(4):
        truth = photographed(mount, seed, robot_deg)
        views = truth.views(grid(9, 6), noise_px, seed)
        # Inaccurate board poses are refitted to the corners.
        rng = np.random.default_rng(seed)
        board = truth.pairs.camera_from_board @ SE3.exp(rng.normal(0, 0.003, (20, 6)))
        pairs = replace(truth.pairs, camera_from_board=board)
        calibration = solve(pairs, mount, corners=BoardCorners(truth.camera, views))
        difference = error(calibration.parent_from_child, truth.parent_from_camera)
        distances.append(
            difference @ np.linalg.solve(calibration.covariance, difference)
        )
        with_corners.append(np.linalg.norm(difference[:3]))
        assert calibration.checks.to_dict()["corner_sigma_px"] == pytest.approx(
            noise_px, rel=0.1
        )
        assert calibration.camera is not None
        assert calibration.camera.fx == pytest.approx(truth.camera.fx, rel=2e-3)
        plain = solve(pairs, mount).parent_from_child
        without.append(np.linalg.norm(error(plain, truth.parent_from_camera)[:3]))
    assert np.median(distances) < 11
    assert np.median(with_corners) < 0.5 * np.median(without)


def test_a_stray_corner_is_named_and_moves_nothing() -> None:
    drawn = record(BoardSetting(noise_px=0.02), 3)
    clean, [*views] = solve_with_corners(drawn), drawn.views
    for i in (2, 7):
        pixels = views[i].pixels.copy()
        pixels[53] += (0.9, 1.2)
        views[i] = replace(views[i], pixels=pixels)
    spoiled = replace(drawn, views=tuple(views))
    assert (
        clean.uncertain_pose.squared_mahalanobis(
            solve_with_corners(spoiled).parent_from_child
        )
        < 0.2
    )
    found = board_poses(
        Board("chessboard", 0.025, 9, 6),
        drawn.camera,
        dict(zip("abcdefghij", views, strict=False)),
    )
    left_out = {image.name: image.left_out for image in found.images if image.left_out}
    assert left_out == {
        name: (tuple(views[i].pixels[53]),) for name, i in (("c", 2), ("h", 7))
    }


def solve_with_corners(drawn: BoardRecording) -> Calibration:
    pairs, corners = corner_pairs(drawn)
    return solve(pairs, "eye_in_hand", corners=corners)


@pytest.mark.parametrize("bend_m", [0.0, 0.002])
def test_a_bent_board_is_no_worse_than_a_flat_one(bend_m: float) -> None:
    distances = []
    for seed in range(6):
        drawn = record(BoardSetting(square_m=0.04), seed)
        x, y = ((drawn.views[0].points_m - drawn.views[0].points_m.mean(0)) / 0.16).T[
            :2
        ]
        bent = drawn.views[0].points_m + np.outer(
            bend_m * (x**2 - 0.4 * x * y), [0, 0, 1]
        )
        rng = np.random.default_rng(seed)
        views = tuple(
            BoardView(
                view.points_m,
                project(bent, pose, drawn.camera) + rng.normal(0, 0.1, (54, 2)),
            )
            for view, pose in zip(drawn.views, drawn.camera_from_board, strict=True)
        )
        found = solve_with_corners(replace(drawn, views=views))
        distances.append(
            found.uncertain_pose.squared_mahalanobis(drawn.parent_from_camera)
        )
        assert found.camera is not None
        sigma = found.checks.to_dict()["camera_sigma"]["fx"]
        assert abs(found.camera.fx - drawn.camera.fx) < 4 * sigma
    assert np.mean(distances) < 10


@pytest.mark.parametrize("size", [(8, 6), (7, 7), (8, 8)])
def test_turned_corners_of_a_symmetric_board_are_corrected(
    size: tuple[int, int],
) -> None:
    truth = photographed("eye_in_hand", 1)
    points = grid(*size)
    square = size[0] == size[1]
    views = list(truth.views(points, 0.0, 0))
    poses = [board_pose(view, truth.camera).camera_from_board for view in views]
    indices = np.arange(len(points)).reshape(size[::-1])
    for i in range(1, len(views), 3):
        order = np.rot90(indices, 1 + i % 3 if square else 2).ravel()
        views[i] = BoardView(points, views[i].pixels[order])
        poses[i] = board_pose(views[i], truth.camera).camera_from_board
    pairs = replace(truth.pairs, camera_from_board=SE3.stack(poses))
    corners = BoardCorners(
        truth.camera, tuple(views), half_turn=not square, quarter_turn=square
    )
    calibration = solve(pairs, "eye_in_hand", corners=corners)
    assert all(image.used for image in calibration.images)
    assert largest_error(calibration, truth.parent_from_camera) < 1e-4


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


@pytest.mark.parametrize(("factor", "warned"), [(1.0, False), (1.05, True)])
def test_a_stated_focal_length_is_compared_with_the_corners(
    factor: float, warned: bool
) -> None:
    pairs, corners = corner_pairs(record(BoardSetting(), 3))
    camera = corners.camera
    stated = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    solved = solve(
        pairs, "eye_in_hand", corners=replace(corners, camera=stated, stated=True)
    )
    warnings = solved.checks.to_dict().get("warnings", ())
    assert any("stated focal length" in words for words in warnings) == warned
