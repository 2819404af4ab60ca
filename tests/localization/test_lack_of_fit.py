"""Images that no camera makes: their residuals have a trend, which widens or rejects a pose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.intrinsics import INTRINSICS
from evercal.localization.lack_of_fit import LackOfFit, lack_of_fit
from evercal.localization.localizer import Localizer
from evercal.localization.matching import turned
from evercal.localization.pose_refinement import Observed, minimise
from evercal.localization.query import Encoded
from evercal.map import Map
from evercal.recordings.samples import sample_rooms

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from evercal.recordings.frame import Frame
    from evercal.typing import Array

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
POSE = SE3.exp(np.array([0.4, -0.3, 1.2, 0.3, -0.5, 0.2]))
NOISE_PX = 0.3
INSIDE_95 = 7.8
"""95 % quantile of chi-squared, three degrees of freedom."""
WRONG_SIGMAS = 5.0
ROOM = sample_rooms()[0].scene


def fitted(warp: Array, seed: int) -> tuple[LackOfFit | None, float]:
    """The lack of fit of an image moved by `warp` (2, 2), and the squared deviation of its pose."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -0.8, 1.5], [1, 0.8, 4.0], (400, 3))
    middle = np.array([319.5, 239.5])
    pixels = (CAMERA.project(points) - middle) @ warp.T + middle
    pixels += rng.normal(0, NOISE_PX, pixels.shape)
    white = np.repeat(np.eye(2)[..., None] / NOISE_PX, len(points), 2)
    observed = Observed(pixels, POSE.apply(points), white, len(points))
    start = POSE.rotation_matrix(), POSE.translation_m
    minimum = minimise(observed, CAMERA, start)
    pose = minimum.pose(np.zeros((6, 6))).pose
    misfit = lack_of_fit(observed, CAMERA, pose, np.zeros(INTRINSICS))
    off = pose.translation_m - POSE.translation_m
    _, covariance = minimum.moved(np.zeros(0))
    covariance = minimum.pose(minimum.variance * covariance).covariance
    if misfit is not None:
        covariance = covariance + misfit.covariance
    return misfit, float(off @ np.linalg.solve(covariance[:3, :3], off))


def test_noise_alone_is_no_trend() -> None:
    trends = [fitted(np.eye(2), seed)[0] for seed in range(60)]
    # Twice a log likelihood ratio of 3 is exceeded by 5 % of chi-squared, two degrees of freedom.
    assert sum(trend is not None for trend in trends) <= 6


@pytest.mark.parametrize(
    ("warp", "words"),
    [
        (np.diag([1.02, 1.0]), "the image is squeezed by "),
        (np.array([[1.0, 0.0125], [0.0, 1.0]]), "rows are sheared by "),
    ],
)
def test_a_squeezed_or_sheared_image_widens_the_covariance_by_its_error(
    warp: Array, words: str
) -> None:
    squares = []
    for seed in range(20):
        misfit, square = fitted(warp, seed)
        assert misfit is not None
        assert misfit.reason.startswith(words)
        squares.append(square)
    assert max(squares) < INSIDE_95


@pytest.fixture(scope="module")
def bedroom(
    tmp_path_factory: pytest.TempPathFactory, shared: Callable[..., Path]
) -> Localizer:
    """A localizer of the packaged bedroom, of each second training frame."""

    def learn() -> Path:
        store = tmp_path_factory.mktemp("bedroom") / "map"
        scene = replace(ROOM, train=ROOM.train[::2], test=())
        Map.open(store).learn(scene, memory="20%")
        return store

    return Localizer.open(shared("bedroom", learn))


def located(
    localizer: Localizer, warp: Array, frames: tuple[Frame, ...]
) -> list[tuple[PoseEstimate, float]]:
    """Answers for images moved by an affine warp (2, 3), and their squared deviations."""
    answers = []
    for frame in frames:
        image = cv2.warpAffine(
            frame.read_image(),
            warp,
            (320, 240),
            None,
            cv2.INTER_CUBIC,
            cv2.BORDER_REPLICATE,
        )
        answer = localizer.localize(image)
        square = 0.0
        pose = answer.uncertain_pose
        if pose is not None:
            truth = frame.base_from_camera
            assert truth is not None
            off = pose.pose.translation_m - truth.translation_m
            square = float(off @ np.linalg.solve(pose.covariance[:3, :3], off))
        answers.append((answer, square))
    return answers


@pytest.mark.parametrize(
    "warp",
    [
        [[1.02, 0, -0.01 * 319], [0, 1, 0]],
        [[1.1, 0, -0.05 * 319], [0, 1, 0]],
        [[1, 0.025, -0.0125 * 239], [0, 1, 0]],
        [[1, 0.0625, -0.03125 * 239], [0, 1, 0]],
    ],
    ids=["squeezed by 2 %", "squeezed by 10 %", "sheared by 6 px", "sheared by 15 px"],
)
def test_a_warped_image_has_no_confident_wrong_answer(
    bedroom: Localizer, warp: list[list[float]]
) -> None:
    answers = located(bedroom, np.array(warp), ROOM.test[::10])
    assert max(square for _, square in answers) < WRONG_SIGMAS**2


def test_a_mirrored_image_is_refused_by_name(bedroom: Localizer) -> None:
    mirror = np.array([[-1.0, 0, 319], [0, 1, 0]])
    answers = located(bedroom, mirror, ROOM.test[::6])
    assert all(answer.status != "ok" for answer, _ in answers)
    named = ["the image is mirrored" in answer.reason for answer, _ in answers]
    assert np.mean(named) > 0.7
    plain = located(bedroom, np.eye(2, 3), ROOM.test[::10])
    assert all(answer.status == "ok" for answer, _ in plain)


@pytest.mark.parametrize("turns", range(4))
def test_a_mirrored_image_is_recognised_in_every_quarter_turn(
    bedroom: Localizer, turns: int
) -> None:
    image = turned(ROOM.test[24].read_image()[:, ::-1], turns)
    query = bedroom.query(image, None)
    features = bedroom.contents.encoder.encode(image, bedroom.contents.short_side)
    mirror = bedroom.poses.matcher.mirrored(replace(query, encoded=Encoded(features)))
    assert mirror is not None
    # The image was turned after it had been mirrored.
    assert mirror.encoded.turns == turns
