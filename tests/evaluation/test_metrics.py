"""Scores against numbers worked out by hand, and against slow twins."""

import json
import math

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from evercal.evaluation import (
    FrameResult,
    continual_scores,
    correct,
    recall_area,
    scores,
    share_inside,
)
from evercal.evaluation.metrics import CHI2_6, FINE
from evercal.geometry import SE3, squared_mahalanobis

DEGREE = math.pi / 180


def result(
    scene: str = "a", centimetres: float = 1.0, degrees: float = 1.0, **other
) -> FrameResult:
    fields = {
        "scene": scene,
        "frame": "f",
        "translation_error_m": centimetres / 100,
        "rotation_error_rad": math.radians(degrees),
        "status": "ok",
        "found_scene": scene,
        "near_training_frame": False,
        "milliseconds": 10.0,
        "inliers": 5,
        "inlier_ratio": 0.5,
    }
    return FrameResult(**{**fields, **other})


def lost(scene: str, status: str, found: str | None) -> FrameResult:
    return result(scene, math.inf, math.inf, status=status, found_scene=found)


def test_an_error_equal_to_a_threshold_is_wrong() -> None:
    rows = [
        result(centimetres=4.999, degrees=4.999),
        result(centimetres=5, degrees=1),
        result(centimetres=1, degrees=5),
        result(centimetres=0.999, degrees=0.999),
        result(centimetres=1, degrees=0.5),
    ]
    assert correct(rows)["a"].tolist() == [True, False, False, True, True]
    assert correct(rows, FINE)["a"].tolist() == [False, False, False, True, False]


def test_scores_of_two_scenes_by_hand() -> None:
    rows = [
        result("a", 1.0, 4.0, milliseconds=20.0),
        lost("b", "unknown_scene", None),
        result("a", 3.0, 2.0, near_training_frame=True),
        result("a", 2.0, 6.0),
        lost("b", "failed", "b"),
        lost("a", "ok", "b"),
        result("b", 0.5, 0.5),
        result("b", 7.0, 3.0),
    ]
    found = scores(rows)
    assert list(found.scenes) == ["a", "b"]
    a, b = found.scenes["a"], found.scenes["b"]
    assert (a.frames, a.accuracy_5cm_5deg, a.accuracy_1cm_1deg) == (4, 50.0, 0.0)
    # The upper of the two middle values, each error sorted for itself: 1 2 [3] inf, 2 4 [6] inf.
    assert a.median_translation_cm == pytest.approx(3.0)
    assert a.median_rotation_deg == pytest.approx(6.0)
    assert (a.wrong_scene, a.unknown, a.near_training_frame) == (25.0, 0.0, 25.0)
    assert (b.accuracy_5cm_5deg, b.accuracy_1cm_1deg) == (25.0, 25.0)
    assert b.median_translation_cm == math.inf
    # A failure in another scene's name gave no pose, so it is no wrong scene.
    assert (b.wrong_scene, b.unknown, b.near_training_frame) == (0.0, 25.0, 0.0)
    assert found.mean_accuracy_5cm_5deg == 37.5
    assert found.ms_per_image == pytest.approx(11.25)


def test_the_mean_over_scenes_does_not_weigh_them_by_frames() -> None:
    rows = [result("small")] + [result("large", 50.0)] * 9
    assert scores(rows).mean_accuracy_5cm_5deg == 50.0


def test_json_has_the_agreed_fields_and_null_for_infinite() -> None:
    text = json.dumps(scores([result("a"), lost("b", "failed", None)]).to_dict(), allow_nan=False)
    data = json.loads(text)
    means = {"mean_accuracy_5cm_5deg", "mean_accuracy_1cm_1deg"}
    assert set(data) == {"scenes", *means, "ms_per_image"}
    assert list(data["scenes"]["b"]) == [
        "frames",
        "accuracy_5cm_5deg",
        "accuracy_2cm_2deg",
        "accuracy_1cm_1deg",
        "accuracy_5mm_05deg",
        "median_translation_cm",
        "median_rotation_deg",
        "wrong_scene",
        "unknown",
        "near_training_frame",
        "inside_95",
    ]
    assert data["scenes"]["b"]["median_translation_cm"] is None
    assert data["scenes"]["a"]["median_translation_cm"] == pytest.approx(1.0)


def test_no_results_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        scores([])


def test_continual_scores_by_hand() -> None:
    nan = math.nan
    accuracies = [
        [90.0, nan, nan, nan],
        [95.0, 80.0, nan, nan],
        [70.0, 85.0, 60.0, nan],
        [75.0, 70.0, 66.0, 40.0],
    ]
    found = continual_scores(accuracies)
    assert found.final_accuracy == pytest.approx((75 + 70 + 66 + 40) / 4)
    # Best with the last stage: 95, 85, 66; without: 95, 85, 60; just learned: 90, 80, 60.
    assert found.total_forgetting == pytest.approx((20 + 15 + 0) / 3)
    assert found.forgetting == pytest.approx((20 + 15 - 6) / 3)
    assert found.backward_transfer == pytest.approx((-15 - 10 + 6) / 3)
    assert found.last_scene_accuracy == 40.0
    total = 90 + 95 + 80 + 70 + 85 + 60 + 75 + 70 + 66 + 40
    assert found.accuracy_along == pytest.approx(total / 10)


def test_what_stands_above_the_diagonal_does_not_count() -> None:
    generator = np.random.default_rng(1)
    matrix = generator.uniform(0, 100, (5, 5))
    hidden = np.where(np.tri(5, dtype=bool), matrix, np.nan)
    assert continual_scores(matrix) == continual_scores(hidden)


def test_the_two_kinds_of_forgetting_differ_only_where_the_end_is_best() -> None:
    generator = np.random.default_rng(2)
    for _ in range(50):
        matrix = generator.uniform(0, 100, (4, 4))
        found = continual_scores(matrix)
        assert found.total_forgetting >= max(found.forgetting, 0.0)
        assert found.forgetting >= -found.backward_transfer - 1e-9
        matrix[-1] = 0.0
        found = continual_scores(matrix)
        assert found.total_forgetting == found.forgetting


def test_one_scene_leaves_nothing_to_forget() -> None:
    found = continual_scores([[70.0]])
    assert (found.final_accuracy, found.last_scene_accuracy) == (70.0, 70.0)
    assert math.isnan(found.total_forgetting)
    assert found.to_dict()["backward_transfer"] is None
    assert found.to_dict()["final_accuracy"] == 70.0


@pytest.mark.parametrize(
    "matrix", [[], [1.0, 2.0], [[1.0, 2.0]], [[1.0, 0.0], [math.nan, 2.0]], np.zeros((2, 2, 2))]
)
def test_a_broken_matrix_is_refused(matrix: object) -> None:
    with pytest.raises(ValueError, match="accuracies"):
        continual_scores(matrix)  # pyright: ignore[reportArgumentType]


def test_squared_errors_follow_chi_square_where_the_covariance_is_right() -> None:
    rng = np.random.default_rng(0)
    deviation = np.array([1e-3, 2e-3, 5e-4, 1e-3, 3e-3, 2e-3])
    root = np.linalg.qr(rng.normal(size=(6, 6)))[0] * deviation
    found = SE3.exp(rng.normal(size=6))
    squared = []
    for error in rng.normal(size=(2000, 6)) @ root.T:
        turned = found @ SE3.exp([0, 0, 0, *error[3:]])
        truth = SE3(turned.rotation_wxyz, found.translation_m + error[:3])
        squared.append(squared_mahalanobis(found, root @ root.T, truth))
    assert kstest(squared, chi2(6).cdf).pvalue > 0.01
    assert chi2(6).cdf(CHI2_6) == pytest.approx(0.95, abs=1e-5)
    assert share_inside(squared) == pytest.approx(95, abs=1.5)


def test_the_share_inside_counts_those_that_have_one() -> None:
    assert share_inside([1.0, 20.0, math.nan, 12.0, math.inf]) == 50.0
    assert math.isnan(share_inside([math.nan]))
    assert math.isnan(share_inside([]))
    rows = [result(squared_mahalanobis=value) for value in (1.0, 20.0, 12.0, math.nan)]
    assert scores(rows).scenes["a"].inside_95 == pytest.approx(200 / 3)
    assert scores([result()]).to_dict()["scenes"]["a"]["inside_95"] is None  # pyright: ignore[reportIndexIssue]


def test_recall_area_is_that_under_the_curve() -> None:
    assert recall_area([0.0, 0.05, 0.2, math.inf]) == pytest.approx(100 * 1.75 / 4)
    errors = np.random.default_rng(3).exponential(0.15, 400)
    grid = np.linspace(0, 0.2, 4001)
    curve = (errors[:, None] <= grid).mean(0)
    assert recall_area(errors) == pytest.approx(500 * np.trapezoid(curve, grid), abs=0.02)
    assert recall_area(errors, 0.1) < recall_area(errors)
