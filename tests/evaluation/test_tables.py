"""Tables contain the scores in both styles."""

import math

from evercal.evaluation import SceneScores, Scores
from evercal.evaluation.tables import score_table


def row(accuracy: float, median_cm: float = 2.0, frames: int = 100) -> SceneScores:
    return SceneScores(frames, accuracy, 8.0, 1.0, 0.7, median_cm, 0.5, 2.0, 3.0, 4.0)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_rows_and_their_mean_in_markdown() -> None:
    scores = Scores({"chess": row(90.0), "a|b": row(61.26, math.inf, 7)}, 75.63, 1.0, 12.0)
    lines = score_table(scores, "markdown").splitlines()
    assert cells(lines[0])[:4] == ["scene", "frames", "5cm 5deg %", "2cm 2deg %"]
    assert set(lines[1]) <= set("|-: ")
    accuracies, medians = ["90.0", "8.0", "1.0", "0.7"], ["20.00", "0.500"]
    assert cells(lines[2]) == ["chess", "100", *accuracies, *medians, "2.0", "3.0", "-", "4.0"]
    assert lines[3].replace(" ", "").startswith("|a\\|b|7|61.3|8.0|1.0|0.7|inf|")
    assert cells(lines[4])[:3] == ["mean", "", "75.6"]
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1


def test_one_scene_has_no_mean() -> None:
    text = score_table(Scores({"chess": row(90.0)}, 90.0, 1.0, 12.0))
    assert "mean" not in text
    assert "|" not in text
    assert len(text.splitlines()) == 3


def test_names_that_look_like_numbers_are_unchanged() -> None:
    text = score_table(Scores({"007": row(90.0), "1e3": row(80.0)}, 85.0, 1.0, 12.0))
    assert "007" in text
    assert "1e3" in text
