"""Stated camera poses, compared with poses that images of an arm show."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from evercal.calibration.audit_by_arm import ArmAudit, Audited
from evercal.calibration.episode_images import ArmPose
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose, pose_distance_mm_deg
from evercal.recordings.episodes.episode import Episode
from evercal.recordings.frame import Frame
from evercal.recordings.poses.conventions import (
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)

TRUTH = SE3.exp([0.9, -0.5, 0.7, 1.1, -0.6, 2.0])
OTHER = SE3.exp([-0.4, 1.2, 0.6, -0.9, 0.3, 1.4])
HAND = SE3.exp([0.3, 0.2, 0.6, 0.4, -0.5, 0.9])
"""base_from_tip in the image."""
HIDDEN = "the images show 12 % of the outline"


@dataclass
class Shown:
    """Images that show a camera near the truth, from any start."""

    sigma_mm: float = 5.0
    confirmed: float = 0.5
    at_stated: float = 0.0
    """Share of the outline that they show beside the stated pose, unless it is right."""
    anywhere_too: bool = True
    starts: list[SE3] = field(default_factory=list)

    def pose(self) -> ArmPose:
        sigma = np.repeat([self.sigma_mm / 1000, np.radians(self.sigma_mm / 20)], 3)
        shown = TRUTH @ SE3.exp([0.004, 0, 0.003, 0, 0.003, 0])
        return ArmPose(UncertainPose(shown, np.diag(sigma**2)), self.confirmed)

    def beside(self, start: SE3) -> ArmPose:
        if pose_distance_mm_deg(start, TRUTH)[0] < 60:
            return self.pose()
        elsewhere = start @ SE3.exp([0.04, 0, 0, 0, 0, 0])
        return ArmPose(UncertainPose(elsewhere, 1e-6 * np.eye(6)), self.at_stated)

    def near(self, starts: Sequence[SE3]) -> ArmPose | None:
        self.starts = [*starts]
        near = [s for s in starts if max(pose_distance_mm_deg(s, TRUTH)) < 60]
        return self.pose() if near else None

    def links(self) -> dict[str, SE3]:
        return {"tip": HAND}

    def anywhere(self) -> ArmPose:
        if not self.anywhere_too:
            raise InputError(HIDDEN)
        return self.pose()


def audited(
    numbers: Any,
    shown: Shown,
    known: Sequence[SE3] = (),
    **more: Any,
) -> Audited:
    camera = Camera(64, 48, 60, 60, 31.5, 23.5)
    image = np.zeros((48, 64, 3), np.uint8)
    frame = Frame("0", image, camera, None, joints_rad=(0.4, 0.1))
    others = {"front": numbers_from_poses(OTHER, pose_convention("rpy")).tolist()}
    stated = {"side": tuple(numbers), **others} if len(numbers) else {}
    episode = Episode("e", "side", (frame,), ("shoulder", "reach"), stated)
    look: Any = lambda _: shown  # noqa: E731
    audit = ArmAudit(look, **more)
    return audit.done(0, (episode, known))


def numbers_of(pose: SE3, convention: str = "rpy") -> list[float]:
    return numbers_from_poses(pose, pose_convention(convention)).tolist()


def corrected(result: Audited, convention: str = "rpy") -> SE3:
    return poses_from_numbers(result.corrected, pose_convention(convention))


def test_a_right_pose_is_right() -> None:
    result = audited(numbers_of(TRUTH), Shown())
    assert (result.verdict, result.mistake) == ("right", "")
    assert result.translation_mm == pytest.approx(5, abs=0.1)
    assert (result.sigma_mm, result.confirmed) == (pytest.approx(5), 0.5)


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        ("inverse", "inverse"),
        ("mm", "other unit of length"),
        ("deg", "other unit of angles"),
        ("order", "written as moving_zyx"),
        ("gripper", "relative to tip"),
    ],
)
def test_usual_mistakes_are_named_and_repaired(mistake: str, words: str) -> None:
    numbers = {
        "inverse": numbers_of(TRUTH.inverse()),
        "mm": numbers_of(TRUTH, "rpy:mm"),
        "deg": numbers_of(TRUTH, "rpy:deg"),
        "order": numbers_of(TRUTH, "moving_zyx"),
        "gripper": numbers_of(HAND.inverse() @ TRUTH),
    }[mistake]
    shown = Shown(anywhere_too=False)  # found by trying the mistake
    result = audited(numbers, shown)
    assert (result.verdict, result.mistake) == ("wrong", words)
    # The numbers are read as they were meant, which is better than what the images show.
    np.testing.assert_allclose(corrected(result).matrix(), TRUTH.matrix(), atol=1e-9)


def test_the_pose_of_another_camera_is_named() -> None:
    global TRUTH
    shown = Shown(anywhere_too=False)
    truth = TRUTH
    try:
        TRUTH = OTHER
        result = audited(numbers_of(truth), shown)
    finally:
        TRUTH = truth
    assert (result.verdict, result.mistake) == ("wrong", "that of front")


def test_a_pose_elsewhere_is_corrected_by_the_images() -> None:
    moved = SE3.exp([0.08, 0.03, 0, 0.05, 0, 0]) @ TRUTH
    result = audited(numbers_of(moved, "matrix"), Shown())
    assert (result.verdict, result.mistake) == ("wrong", "")
    distance = pose_distance_mm_deg(corrected(result, "matrix"), TRUTH)
    assert distance[0] == pytest.approx(5, abs=0.1)


def test_poses_of_other_episodes_are_tried() -> None:
    shown = Shown(anywhere_too=False)
    result = audited(numbers_of(OTHER @ OTHER), shown, [TRUTH])
    assert result.verdict == "wrong"
    result = audited(numbers_of(OTHER @ OTHER), shown)
    assert (result.verdict, result.reason) == ("unknown", HIDDEN)
    assert result.corrected == ()


def test_nothing_is_accused_on_weak_evidence() -> None:
    far = SE3.exp([0.2, 0.1, 0, 0.3, 0, 0]) @ TRUTH
    assert audited(numbers_of(far), Shown()).verdict == "wrong"
    # The images show nearly as much of the arm at the stated pose.
    weak = audited(numbers_of(far), Shown(at_stated=0.42))
    assert weak.verdict == "unknown"
    assert "hardly less of the arm at the stated one" in weak.reason
    # They do not decide the pose.
    shift = SE3.exp([0.04, 0, 0, 0, 0, 0]) @ TRUTH
    assert audited(numbers_of(shift), Shown()).verdict == "wrong"
    assert audited(numbers_of(shift), Shown(sigma_mm=15)).verdict == "unknown"
    # Neither do they after a pose beside the stated one that was surely another.
    shift = SE3.exp([0.08, 0, 0, 0, 0, 0]) @ TRUTH
    wide = audited(numbers_of(shift), Shown(sigma_mm=40, at_stated=0.3))
    assert wide.verdict == "unknown"
    # They show too little of the arm beside a pose that is right.
    hidden = Shown(confirmed=0.12, anywhere_too=False)
    hidden.near = lambda _: None  # pyright: ignore[reportAttributeAccessIssue]
    assert audited(numbers_of(TRUTH), hidden).verdict == "unknown"


def test_a_pose_of_all_or_of_none() -> None:
    result = audited((), Shown())
    assert (result.verdict, result.reason) == ("unknown", "states no pose")
    assert len(result.corrected) == 16
    assert audited((), Shown(), of_all=TRUTH).verdict == "right"
    assert audited((), Shown(), of_all=OTHER).verdict == "wrong"


def test_an_episode_that_cannot_be_read_is_unknown() -> None:
    audit = ArmAudit(lambda _: pytest.fail("read"))
    episode = Episode("e", problem="video is missing")
    result = audit.done(0, (episode, ()))
    expected = Audited("e", "", (), "unknown", "video is missing")
    assert replace(result, seconds=0.0) == expected
