"""Tables say what the scores say, in either form."""

import math

import pytest

from evercal.evaluation import (
    SceneScores,
    Scores,
    continual_scores,
    continual_table,
    matrix_table,
    score_table,
)


def row(accuracy: float, median: float = 2.0, frames: int = 100) -> SceneScores:
    return SceneScores(frames, accuracy, 1.0, median, 0.5, 2.0, 3.0, 4.0)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_scene_rows_and_their_mean_in_markdown() -> None:
    scores = Scores({"chess": row(90.0), "a|b": row(61.26, math.inf, 7)}, 75.63, 12.0)
    lines = score_table(scores, "markdown").splitlines()
    assert cells(lines[0])[:4] == ["scene", "frames", "5cm 5deg %", "1cm 1deg %"]
    assert set(lines[1]) <= set("|-: ")
    assert cells(lines[2]) == ["chess", "100", "90.0", "1.0", "2.0", "0.50", "2.0", "3.0", "4.0"]
    assert lines[3].replace(" ", "").startswith("|a\\|b|7|61.3|1.0|inf|")
    assert cells(lines[4])[:3] == ["mean", "", "75.6"]
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1


def test_one_scene_needs_no_mean_and_the_terminal_no_bars() -> None:
    text = score_table(Scores({"chess": row(90.0)}, 90.0, 12.0))
    assert "mean" not in text
    assert "|" not in text
    assert len(text.splitlines()) == 3


def test_numbers_that_look_alike_are_left_alone() -> None:
    """A scene called 007 or 1e3 keeps its name."""
    text = score_table(Scores({"007": row(90.0), "1e3": row(80.0)}, 85.0, 12.0))
    assert "007" in text
    assert "1e3" in text


def test_methods_and_missing_numbers() -> None:
    methods = {"ours": continual_scores([[90, 0], [80, 70]]), "one": continual_scores([[50]])}
    lines = continual_table(methods, "markdown").splitlines()
    assert cells(lines[0]) == ["method", "final %", "last scene %", "TFR", "forgetting", "BWT"]
    assert cells(lines[2]) == ["ours", "75.0", "70.0", "10.0", "10.0", "-10.0"]
    assert cells(lines[3]) == ["one", "50.0", "50.0", "-", "-", "-"]


def test_the_matrix_leaves_the_future_blank() -> None:
    lines = matrix_table([[90, 12], [80, 70]], ["a", "b"], "markdown").splitlines()
    assert cells(lines[0]) == ["after", "a", "b"]
    assert cells(lines[2]) == ["+ a", "90.0", ""]
    assert cells(lines[3]) == ["+ b", "80.0", "70.0"]
    with pytest.raises(ValueError, match="2 scenes"):
        matrix_table([[90.0]], ["a", "b"])
