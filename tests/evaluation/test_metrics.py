"""Scores against numbers by hand and against slow twins."""

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
from evercal.geometry import SE3, UncertainPose

DEGREE = math.pi / 180


def result(scene="a", centimetres=1.0, degrees=1.0, **other):
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
    return FrameResult(**(fields | other))


def without_pose(scene, status, estimated):
    return result(scene, math.inf, math.inf, status=status, found_scene=estimated)


def test_error_equal_to_a_threshold_is_incorrect():
    rows = [
        result(centimetres=4.999, degrees=4.999),
        result(centimetres=5, degrees=1),
        result(centimetres=1, degrees=5),
        result(centimetres=0.999, degrees=0.999),
        result(centimetres=1, degrees=0.5),
    ]
    assert correct(rows)["a"].tolist() == [True, False, False, True, True]
    assert correct(rows, FINE)["a"].tolist() == [False, False, False, True, False]


def test_scores_of_two_scenes_by_hand():
    rows = [
        result("a", 1.0, 4.0, milliseconds=20.0),
        without_pose("b", "unknown_scene", None),
        result("a", 3.0, 2.0, near_training_frame=True),
        result("a", 2.0, 6.0),
        without_pose("b", "failed", "b"),
        without_pose("a", "ok", "b"),
        result("b", 0.5, 0.5),
        result("b", 7.0, 3.0),
    ]
    total = scores(rows)
    assert list(total.scenes) == ["a", "b"]
    a = total.scenes["a"]
    b = total.scenes["b"]
    assert (a.frames, a.accuracy_5cm_5deg, a.accuracy_1cm_1deg) == (4, 50.0, 0.0)
    # The upper median of each error: 1 2 [3] inf and 2 4 [6] inf.
    medians = (a.median_translation_cm, a.median_rotation_deg)
    assert medians == pytest.approx((3.0, 6.0))
    assert (a.wrong_scene, a.unknown, a.near_training_frame) == (25.0, 0.0, 25.0)
    assert b.accuracy_5cm_5deg == b.accuracy_1cm_1deg == 25.0
    assert b.median_translation_cm == math.inf
    # A failure that names another scene has no pose, so it does not count as wrong scene.
    assert (b.wrong_scene, b.unknown, b.near_training_frame) == (0.0, 25.0, 0.0)
    assert total.mean_accuracy_5cm_5deg == 37.5
    assert total.ms_per_image == pytest.approx(11.25)
    rows = [result("small")] + [result("large", 50.0)] * 9
    # The mean over scenes is unweighted.
    assert scores(rows).mean_accuracy_5cm_5deg == 50.0
    with pytest.raises(ValueError, match="at least one"):
        scores([])


def test_json_has_null_for_infinity():
    total = scores([result("a"), without_pose("b", "failed", None)])
    data = json.loads(json.dumps(total.to_dict(), allow_nan=False))
    means = {"mean_accuracy_5cm_5deg", "mean_accuracy_1cm_1deg"}
    assert set(data) == {"scenes", *means, "ms_per_image"}
    assert data["scenes"]["b"]["median_translation_cm"] is None
    assert data["scenes"]["a"]["median_translation_cm"] == pytest.approx(1.0)


def test_continual_scores_by_hand():
    accuracies = np.full((4, 4), math.nan)
    learned = [90, 95, 80, 70, 85, 60, 75, 70, 66, 40]
    accuracies[np.tril_indices(4)] = learned
    # Best: 95, 85, 66; best before the last stage: 95, 85, 60; just learned: 90, 80, 60.
    expected = {
        "final_accuracy": (75 + 70 + 66 + 40) / 4,
        "total_forgetting": (20 + 15 + 0) / 3,
        "forgetting": (20 + 15 - 6) / 3,
        "backward_transfer": (-15 - 10 + 6) / 3,
        "last_scene_accuracy": 40.0,
        "accuracy_along": np.mean(learned),
    }
    assert continual_scores(accuracies).to_dict() == pytest.approx(expected)


def test_continual_scores_match_a_literal_loop():
    """Random accuracies of up to twelve scenes; each score as its formula is written."""
    generator = np.random.default_rng(5)
    for scenes in [*range(2, 13)] * 5:
        a = generator.uniform(0, 100, (scenes, scenes))
        drops, drops_before, changes, along = [], [], [], []
        for j in range(scenes - 1):
            accuracies = [a[i, j] for i in range(j, scenes)]
            drops.append(max(accuracies) - accuracies[-1])
            drops_before.append(max(accuracies[:-1]) - accuracies[-1])
            changes.append(accuracies[-1] - accuracies[0])
        for i in range(scenes):
            along += [a[i, j] for j in range(i + 1)]
        assert continual_scores(a).to_dict() == pytest.approx(
            {
                "final_accuracy": sum(a[-1]) / scenes,
                "total_forgetting": sum(drops) / (scenes - 1),
                "forgetting": sum(drops_before) / (scenes - 1),
                "backward_transfer": sum(changes) / (scenes - 1),
                "last_scene_accuracy": a[-1, -1],
                "accuracy_along": sum(along) / len(along),
            }
        )


def test_kinds_of_forgetting_differ_only_if_the_end_is_best():
    generator = np.random.default_rng(2)
    for _ in range(50):
        matrix = generator.uniform(0, 100, (4, 4))
        total = continual_scores(matrix)
        upper = np.triu(np.full((4, 4), np.nan), 1)
        assert total == continual_scores(matrix + upper)
        assert total.total_forgetting >= max(total.forgetting, 0.0)
        assert total.forgetting >= -total.backward_transfer - 1e-9
        matrix[-1] = 0.0
        total = continual_scores(matrix)
        assert total.total_forgetting == total.forgetting


def test_single_scene_has_no_forgetting():
    total = continual_scores([[70.0]])
    assert total.final_accuracy == total.last_scene_accuracy == 70.0
    assert total.to_dict()["backward_transfer"] is None


@pytest.mark.parametrize(
    "matrix",
    [[], [1.0, 2.0], [[1.0, 2.0]], [[1.0, 0.0], [math.nan, 2.0]], np.zeros((2, 2, 2))],
)
def test_invalid_matrix_is_refused(matrix):
    with pytest.raises(ValueError, match="accuracies"):
        continual_scores(matrix)  # pyright: ignore[reportArgumentType]


def test_squared_errors_follow_chi_square_if_the_covariance_is_true():
    rng = np.random.default_rng(0)
    deviation = np.array([1e-3, 2e-3, 5e-4, 1e-3, 3e-3, 2e-3])
    root = np.linalg.qr(rng.normal(size=(6, 6)))[0] * deviation
    estimate = SE3.exp(rng.normal(size=6))
    uncertain = UncertainPose(estimate, root @ root.T)
    squared = []
    for error in rng.normal(size=(2000, 6)) @ root.T:
        rotated = estimate @ SE3.exp([0, 0, 0, *error[3:]])
        truth = SE3(rotated.rotation_wxyz, estimate.translation_m + error[:3])
        squared.append(uncertain.squared_mahalanobis(truth))
    assert kstest(squared, chi2(6).cdf).pvalue > 0.01
    assert chi2(6).cdf(CHI2_6) == pytest.approx(0.95, abs=1e-5)
    assert share_inside(squared) == pytest.approx(95, abs=1.5)


def test_share_inside_ignores_nan():
    assert share_inside([1.0, 20.0, math.nan, 12.0, math.inf]) == 50.0
    assert math.isnan(share_inside([math.nan]))
    assert math.isnan(share_inside([]))
    rows = [result(squared_mahalanobis=d) for d in (1.0, 20.0, 12.0, math.nan)]
    assert scores(rows).scenes["a"].inside_95 == pytest.approx(200 / 3)
    assert scores([result()]).to_dict()["scenes"]["a"]["inside_95"] is None  # pyright: ignore[reportIndexIssue]


def test_recall_area_equals_the_integral():
    assert recall_area([0.0, 0.05, 0.2, math.inf]) == pytest.approx(100 * 1.75 / 4)
    errors = np.random.default_rng(3).exponential(0.15, 400)
    grid = np.linspace(0, 0.2, 4001)
    curve = (errors[:, None] <= grid).mean(0)
    assert recall_area(errors) == pytest.approx(
        500 * np.trapezoid(curve, grid), abs=0.02
    )
    assert recall_area(errors, 0.1) < recall_area(errors)
