"""`solve`: right answers, honest uncertainty, outliers, order, scale."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import Setting, error, recording, rotations, trials
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.solve import BoardCorners, solve
from evercal.evaluation import share_inside
from evercal.geometry import SE3, Camera, average_poses, pose_distance, squared_mahalanobis

MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")
EXACT = Setting(noise_mm=0, noise_deg=0)


@settings(max_examples=10, deadline=None)
@given(
    st.sampled_from(MOUNTS),
    st.integers(0, 10**6),
    st.sampled_from(["random", "table"]),
    st.sampled_from([None, 0.01, 3.0]),
)
def test_exact_poses_give_the_exact_answer(
    mount: Mount, seed: int, path: str, scale: float | None
) -> None:
    drawn = recording(replace(EXACT, mount=mount, path=path, scale=scale), seed)
    found = solve(drawn.pairs, mount, scale is None)
    assert np.abs(error(found.parent_from_child, drawn.parent_from_camera)).max() < 1e-6
    assert found.parent_frame == ("gripper" if mount == "eye_in_hand" else "base")
    assert all(image.used for image in found.images)
    if scale is not None:
        assert found.checks["scale"] == pytest.approx(scale, rel=1e-6)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("outliers", [0, 3])
def test_errors_and_their_ellipsoid(mount: Mount, outliers: int) -> None:
    # The study of a thousand trials is a benchmark; here only what a broken covariance would miss.
    found = trials(Setting(mount, outliers=outliers), 40, 100)
    assert found["median mm"] < 1.4
    assert found["median deg"] < 0.1
    assert found["largest mm"] < 6
    assert found["inside 95 %"] > 80
    assert found["outliers exactly"] >= 97


def test_the_ellipsoid_is_not_too_wide() -> None:
    distances = []
    for seed in range(40):
        drawn = recording(Setting(noisy="both"), 200 + seed)
        found = solve(drawn.pairs, "eye_in_hand")
        answer, truth = found.parent_from_child, drawn.parent_from_camera
        distances.append(squared_mahalanobis(answer, found.covariance, truth))
    # Mean of chi-square is 6; half of them lie within 5.35.
    assert 4.2 < np.mean(distances) < 7.8
    assert 0.25 < np.mean(np.array(distances) < 5.35) < 0.75
    assert share_inside(distances) > 80


def test_outliers_are_named_and_the_order_does_not_matter() -> None:
    setting = Setting("eye_to_hand", outliers=5)
    drawn = recording(setting, 3)
    found = solve(drawn.pairs, "eye_to_hand")
    left_out = {i for i, image in enumerate(found.images) if not image.used}
    assert left_out == set(drawn.spoiled)
    for i in left_out:
        image = found.images[i]
        assert "disagrees with the others by" in image.reason
        assert image.residual_mm is not None
        assert 20 < image.residual_mm < 120
        assert image.residual_deg == pytest.approx(20, abs=2)
    order = np.random.default_rng(0).permutation(25)
    again = solve(drawn.pairs[order], "eye_to_hand")
    assert np.abs(again.parent_from_child.matrix() - found.parent_from_child.matrix()).max() < 1e-12
    assert np.allclose(again.covariance, found.covariance, rtol=1e-9)
    assert [image.name for image in again.images] == [drawn.pairs.names[i] for i in order]


def test_a_third_of_wrong_poses_is_borne() -> None:
    for seed in range(5):
        drawn = recording(Setting(outliers=9), seed)
        found = solve(drawn.pairs, "eye_in_hand")
        off = error(found.parent_from_child, drawn.parent_from_camera)
        assert np.linalg.norm(off[:3]) < 0.005
        assert {i for i, image in enumerate(found.images) if not image.used} == set(drawn.spoiled)


@pytest.mark.parametrize("mount", MOUNTS)
def test_unknown_scale(mount: Mount) -> None:
    found = trials(Setting(mount, scale=0.37, outliers=3), 10)
    assert found["scale off %"] < 0.5
    assert found["median mm"] < 2.0


def test_repeats_add_nothing() -> None:
    drawn = recording(Setting(), 4)
    twice = drawn.pairs[np.concatenate([np.arange(25), np.arange(10)])]
    named = replace(twice, names=tuple(f"image {i}" for i in range(35)))
    once, found = solve(drawn.pairs, "eye_in_hand"), solve(named, "eye_in_hand")
    assert np.allclose(found.covariance, once.covariance, rtol=1e-9)
    assert [image.used for image in found.images] == [True] * 25 + [False] * 10
    assert found.images[30].reason == "repeats image 5, which adds nothing"


def test_checks_and_terms_tell_what_they_say() -> None:
    drawn = recording(Setting(noise_mm=1.0, noise_deg=0.05, path="table"), 5)
    found = solve(drawn.pairs, "eye_in_hand")
    # A pose that was left out is off by its own noise and a little more, three axes together.
    assert 1.2 < found.checks["held_out_mm"] < 3.0
    assert 1.4 < found.checks["residual_mm"] < 2.4
    assert found.checks["poses_used"] == 25
    assert found.checks["warnings"] == []
    board = found.checks["base_from_board"]
    metres, _ = pose_distance(
        SE3(board["quaternion_wxyz"], board["translation_m"]), drawn.fixed_from_board
    )
    assert metres < 0.003
    squared = sum(term.translation_mm**2 for term in found.error_terms)
    assert np.sqrt(squared) == pytest.approx(found.sigma_mm, rel=0.02)


def seen(mount: Mount, seed: int, noise_px: float, robot_deg: float = 0.0) -> tuple:
    """A chessboard seen by a camera, with noisy corners, and robot poses with noise of rotation."""
    rng = np.random.default_rng(seed)
    camera = Camera(1280, 960, 1000, 1000, 640, 480, (-0.1, 0.05, 0.001, 0.0))
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    points = 0.03 * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)
    on_arm = mount == "eye_in_hand"
    n = 20
    turn = Rotation.from_rotvec(rng.normal(0, 0.35, (n, 3)))
    middle = turn.apply(np.tile([0.12, 0.075, 0], (n, 1)))
    place = np.array([0, 0, 0.6]) + rng.normal(0, 0.06, (n, 3)) - middle
    seen_board = SE3(turn.as_quat(scalar_first=True), place)
    parent_from_camera = SE3.exp([0.05, -0.1, 0.08, 0.3, 0.2, -1.5])
    fixed_from_board = SE3.exp([0.5, 0.1, 0.2, 2.0, 1.0, 0.1])
    robot = fixed_from_board @ (parent_from_camera @ seen_board).inverse()
    robot = robot if on_arm else robot.inverse()
    wobble = np.concatenate(
        [np.zeros((n, 3)), rng.normal(0, np.deg2rad(robot_deg) + 1e-12, (n, 3))], 1
    )
    robot = robot @ SE3.exp(wobble)
    views = []
    for pose in seen_board:
        pixels = camera.project(pose.apply(points)) + rng.normal(0, noise_px, (len(points), 2))
        views.append(BoardView(points, pixels))
    return robot, seen_board, parent_from_camera, camera, tuple(views)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize(("noise_px", "robot_deg"), [(0.3, 0.0), (0.1, 0.1)])
def test_corners_are_weighed_by_what_they_tell(
    mount: Mount, noise_px: float, robot_deg: float
) -> None:
    distances, sizes, plain = [], [], []
    for seed in range(12):
        robot, board, truth, camera, views = seen(mount, seed, noise_px, robot_deg)
        names = tuple(f"{i}.png" for i in range(len(board)))
        # Poses that are somewhat off: the corners decide.
        rng = np.random.default_rng(seed)
        loose = board @ SE3.exp(rng.normal(0, 0.003, (len(board), 6)))
        pairs = recording(EXACT, 0).pairs
        pairs = replace(pairs, names=names, base_from_gripper=robot, camera_from_board=loose)
        found = solve(pairs, mount, corners=BoardCorners(camera, views))
        off = error(found.parent_from_child, truth)
        distances.append(off @ np.linalg.solve(found.covariance, off))
        sizes.append(np.linalg.norm(off[:3]))
        assert found.checks["corner_sigma_px"] == pytest.approx(noise_px, rel=0.1)
        assert found.camera == camera
        rough = solve(pairs, mount)
        plain.append(np.linalg.norm(error(rough.parent_from_child, truth)[:3]))
    assert np.median(distances) < 11
    assert np.median(sizes) < 0.5 * np.median(plain)


def test_a_board_counted_from_the_other_end_is_turned() -> None:
    robot, board, truth, camera, _ = seen("eye_in_hand", 1, 0.1)
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    points = 0.03 * np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)
    flipped = []
    poses = []
    half = SE3(np.array([0.0, 0.0, 0.0, 1.0]), points.max(0))
    for i, pose in enumerate(board):
        pixels = camera.project(pose.apply(points))
        turned = i % 4 == 1
        flipped.append(BoardView(points, pixels[::-1] if turned else pixels))
        poses.append(pose @ half if turned else pose)
    pairs = replace(
        recording(EXACT, 0).pairs,
        names=tuple(map(str, range(len(board)))),
        base_from_gripper=robot,
        camera_from_board=SE3.stack(poses),
    )
    found = solve(pairs, "eye_in_hand", corners=BoardCorners(camera, tuple(flipped), True))
    assert all(image.used for image in found.images)
    assert np.abs(error(found.parent_from_child, truth)).max() < 1e-4


REAL = os.environ.get("EVERCAL_REAL_DATA", "")


def real(name: str) -> tuple[SE3, Path]:
    folder = Path(REAL) / "handeye" / name
    if not REAL or not folder.is_dir():
        pytest.skip("EVERCAL_REAL_DATA names no folder with real hand-eye recordings")
    rows = np.loadtxt(folder / "base_from_gripper.csv", delimiter=",", skiprows=1)
    turn = Rotation.from_rotvec(rows[:, 3:]).as_quat(scalar_first=True)
    return SE3(turn, rows[:, :3]), folder


def solved(name: str, mount: Mount, board: object, camera: Camera | None) -> tuple[SE3, SE3]:
    """parent_from_camera, and where the board lies in the fixed frame by each image."""
    from evercal.calibration.boards.board_poses import board_poses
    from evercal.calibration.boards.detection import Board, find_board
    from evercal.calibration.boards.intrinsics import calibrate_camera
    from evercal.recordings import read_image

    assert isinstance(board, Board)
    robot, folder = real(name)
    files = sorted(folder.glob("image-*"))
    images = {path.name: read_image(path) for path in files}
    views = {name: find_board(image, board) for name, image in images.items()}
    assert not [view for view in views.values() if isinstance(view, str)]
    found = [view for view in views.values() if isinstance(view, BoardView)]
    if camera is None:
        height, width = images[files[0].name].shape[:2]
        camera = calibrate_camera(found, width, height).camera
    poses = board_poses(board, camera, views)
    seen_board = SE3.stack([i.camera_from_board for i in poses.images if i.camera_from_board])
    pairs = replace(
        recording(EXACT, 0).pairs,
        names=tuple(views),
        base_from_gripper=robot,
        camera_from_board=seen_board,
    )
    answer = solve(pairs, mount, corners=BoardCorners(camera, tuple(found))).parent_from_child
    fixed = robot if mount == "eye_in_hand" else robot.inverse()
    return answer, fixed @ answer @ seen_board


FRANKA = Camera(640, 480, 607.593, 607.575, 323.463, 243.255)


def test_franka_with_the_camera_on_its_hand() -> None:
    from evercal.calibration.boards.detection import Board

    found, boards = solved(
        "franka_eye_in_hand", "eye_in_hand", Board("chessboard", 0.0236, 9, 6), FRANKA
    )
    turn = Rotation.from_rotvec(np.deg2rad([0.08, 0.55, 90.64]))
    park = SE3(turn.as_quat(scalar_first=True), np.array([0.0579, -0.0341, -0.0424]))
    metres, radians = pose_distance(found, park)
    assert metres < 0.002
    assert np.rad2deg(radians) < 0.3
    assert np.median(pose_distance(average_poses(boards), boards)[0]) < 0.0045


def test_franka_beside_the_camera() -> None:
    from evercal.calibration.boards.detection import Board

    tag = Board("apriltag", 0.048, dictionary="APRILTAG_36h11")
    _, tags = solved("franka_eye_to_hand", "eye_to_hand", tag, FRANKA)
    assert tags.translation_m.std(0).max() < 0.003


@pytest.mark.slow
def test_kuka() -> None:
    from evercal.calibration.boards.detection import Board

    found, boards = solved(
        "kuka_eye_in_hand", "eye_in_hand", Board("chessboard", 0.015, 24, 17), None
    )
    metres, radians = pose_distance(average_poses(boards), boards)
    assert np.median(metres) < 0.0007
    assert np.rad2deg(np.median(radians)) < 0.05
    assert np.linalg.norm(found.translation_m - (0.014, -0.108, -0.082)) < 0.002
    assert rotations(found).magnitude() > 0
