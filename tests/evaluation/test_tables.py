"""Tables say what the scores say, in either form."""

import math

import pytest

from evercal.evaluation import SceneScores, Scores
from evercal.evaluation.tables import distance, score_table


def row(accuracy: float, median: float = 2.0, frames: int = 100) -> SceneScores:
    return SceneScores(frames, accuracy, 8.0, 1.0, 0.7, median, 0.5, 2.0, 3.0, 4.0)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_scene_rows_and_their_mean_in_markdown() -> None:
    scores = Scores({"chess": row(90.0), "a|b": row(61.26, math.inf, 7)}, 75.63, 1.0, 12.0)
    lines = score_table(scores, "markdown").splitlines()
    assert cells(lines[0])[:4] == ["scene", "frames", "5cm 5deg %", "2cm 2deg %"]
    assert set(lines[1]) <= set("|-: ")
    shares, median, rest = (
        ["90.0", "8.0", "1.0", "0.7"],
        "2.0 cm",
        ["0.50", "2.0", "3.0", "-", "4.0"],
    )
    assert cells(lines[2]) == ["chess", "100", *shares, median, *rest]
    assert lines[3].replace(" ", "").startswith("|a\\|b|7|61.3|8.0|1.0|0.7|infcm|")
    assert cells(lines[4])[:3] == ["mean", "", "75.6"]
    assert len({line.replace("\\|", "").count("|") for line in lines}) == 1


def test_one_scene_needs_no_mean_and_the_terminal_no_bars() -> None:
    text = score_table(Scores({"chess": row(90.0)}, 90.0, 1.0, 12.0))
    assert "mean" not in text
    assert "|" not in text
    assert len(text.splitlines()) == 3


def test_numbers_that_look_alike_are_left_alone() -> None:
    """A scene called 007 or 1e3 keeps its name."""
    text = score_table(Scores({"007": row(90.0), "1e3": row(80.0)}, 85.0, 1.0, 12.0))
    assert "007" in text
    assert "1e3" in text


@pytest.mark.parametrize(
    ("metres", "said"),
    [
        (0.000966, "0.97 mm"),
        (0.00999, "9.99 mm"),
        (0.009996, "1.0 cm"),  # rounds to 10 mm, which is a centimetre
        (0.01, "1.0 cm"),
        (0.234, "23.4 cm"),
        (math.nan, "-"),
    ],
)
def test_lengths_are_millimetres_below_a_centimetre(metres: float, said: str) -> None:
    assert distance(metres) == said
