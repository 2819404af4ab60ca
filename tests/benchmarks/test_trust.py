"""`benchmarks trust`: errors of a hobby arm, chosen images, the fitted frame, summaries."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import trust
from benchmarks.arm_noise import ARM_DEG, ARM_MM, arm_errors, grippers, with_arm_errors
from benchmarks.rows import Row
from evercal.geometry import SE3, Camera, pose_distance, pose_distance_mm_deg
from evercal.recordings import Frame, Recording


def path(count: int) -> SE3:
    """A path of the gripper with a turn on every axis."""
    along = np.linspace(0, 1, count)[:, None]
    shift = np.sin(2 * np.pi * along * [1.3, 2.1, 0.7])
    turns = Rotation.from_rotvec(np.cos(2 * np.pi * along * [0.9, 1.7, 1.1]))
    return SE3(turns.as_quat(canonical=True, scalar_first=True), shift)


def rms(errors: np.ndarray) -> tuple[float, float]:
    """Root mean square length in mm and degrees of errors (..., 6)."""
    parts = np.linalg.norm(errors.reshape(-1, 2, 3), axis=-1)
    mm, rad = np.sqrt((parts**2).mean(0))
    return 1000 * float(mm), float(np.rad2deg(rad))


def test_the_errors_of_an_arm_have_their_stated_size() -> None:
    errors = np.stack(
        [arm_errors(path(91), np.random.default_rng(i)) for i in range(300)]
    )
    assert rms(errors) == pytest.approx((ARM_MM, ARM_DEG), rel=0.05)
    # What the draws share is backlash: a third of the variance, with the sign of the motion.
    backlash = errors.mean(0)
    assert rms(backlash) == pytest.approx(
        (ARM_MM / np.sqrt(3), ARM_DEG / np.sqrt(3)), rel=0.05
    )
    moves = np.diff(path(91).translation_m, axis=0)
    assert (np.sign(backlash[1:, :3]) == np.sign(moves)).all()
    # Neighbours share drift: after backlash, half of the variance.
    rest = errors - backlash
    shared = (rest[:, 1:] * rest[:, :-1]).mean((0, 1)) / (rest**2).mean((0, 1))
    assert shared == pytest.approx(0.5, abs=0.05)


def test_the_errors_of_an_arm_move_its_gripper() -> None:
    camera = Camera(4, 4, 1, 1, 1, 1)
    poses = path(91)
    image = np.zeros((4, 4, 3), np.uint8)
    frames = tuple(
        Frame(f"{i}", image, camera, None, pose) for i, pose in enumerate(poses)
    )
    recording = Recording("arm", frames, ())
    noisy = grippers(with_arm_errors(recording, np.random.default_rng(0)))
    metres, radians = pose_distance(poses, noisy)
    errors = arm_errors(poses, np.random.default_rng(0)).reshape(-1, 2, 3)
    np.testing.assert_allclose(metres, np.linalg.norm(errors[:, 0], axis=1))
    np.testing.assert_allclose(radians, np.linalg.norm(errors[:, 1], axis=1))


def test_few_images_are_spread_over_the_recording() -> None:
    for seed in range(20):
        chosen = trust.spread(91, 8, np.random.default_rng(seed))
        assert len(set(chosen)) == 8
        assert [i * 8 // 91 for i in chosen] == pytest.approx(range(8), abs=1)
        assert chosen[0] >= 0
        assert chosen[-1] < 91
    assert trust.spread(91, 91, np.random.default_rng(0)) == list(range(91))


def test_the_fitted_frame_undoes_a_motion_of_the_base() -> None:
    true = path(30)
    offset = SE3.exp([0.02, -0.01, 0.03, 0.02, 0.01, -0.03])
    moved = [offset @ pose for pose in true]
    moved[3] = moved[3] @ SE3.exp([0.5, 0, 0, 0, 1, 0])  # one wrong answer
    fitted = trust.frame_offset(SE3.stack(moved), true)
    assert max(pose_distance_mm_deg(fitted, offset)) < 1e-6


def test_summaries_count_wrong_answers_and_refusals() -> None:
    nothing = {"mm": np.nan, "deg": np.nan, "squared_mahalanobis": np.nan}
    common: Row = {"case": "own camera", "status": "ok"}
    rows: list[Row] = [
        common | {"mm": 2.0, "deg": 0.1, "squared_mahalanobis": 3.0},
        common | {"mm": 20.0, "deg": 0.1, "squared_mahalanobis": 30.0},
        common | {"mm": np.inf, "deg": np.inf, "squared_mahalanobis": np.inf},
        common | nothing | {"status": "failed"},
        common | nothing | {"case": "refused", "status": "failed"},
    ]
    summary = trust.summary(rows, ["case"]).set_index("case")
    own = summary.loc["own camera"]
    refused = summary.loc["refused"]
    assert own[["n", "located", "1 cm/1 deg %", "wrong"]].tolist() == [4, 3, 25.0, 2]
    assert own["median mm"] == 20.0
    assert np.isinf(own["95 % mm"])
    assert own["in ellipsoid %"] == pytest.approx(100 / 3)
    assert refused[["n", "wrong"]].tolist() == [1, 0]
