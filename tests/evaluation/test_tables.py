"""Rows of a table contain the scores."""

import math

from evercal.evaluation import SceneScores, Scores
from evercal.evaluation.tables import score_rows


def row(accuracy, median_cm=2.0, frames=100):
    return SceneScores(frames, accuracy, 8.0, 1.0, 0.7, median_cm, 0.5, 2.0, 3.0, 4.0)


def test_rows_and_their_mean():
    scores = Scores(
        {"chess": row(90.0), "fire": row(61.26, math.inf, 7)}, 75.63, 1.0, 12.0
    )
    chess, fire, mean = (list(cells.values()) for cells in score_rows(scores))
    accuracies = ["90.0", "8.0", "1.0", "0.7"]
    medians = ["20.00", "0.500"]
    assert chess == ["chess", "100", *accuracies, *medians, "2.0", "3.0", "-", "4.0"]
    assert fire[:7] == ["fire", "7", "61.3", "8.0", "1.0", "0.7", "inf"]
    assert mean[:3] == ["mean", "", "75.6"]
    assert list(score_rows(scores)[0])[:3] == ["scene", "frames", "5cm 5deg %"]
    del scores.scenes["fire"]
    assert len(score_rows(scores)) == 1  # one scene has no mean
