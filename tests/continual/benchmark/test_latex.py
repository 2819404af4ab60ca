"""The table of the paper in LaTeX."""

import math

import pytest
from evercal.continual.benchmark.latex import paper_table

from evercal.continual.benchmark.comparison import runs_of
from evercal.continual.benchmark.results import SceneResult


def result(strategy: str, stage: int, scene: str, errors: list[float]) -> SceneResult:
    return SceneResult(
        strategy=strategy,
        seed=0,
        stage=stage,
        scene=scene,
        frames=tuple(str(i) for i in range(len(errors))),
        translation_m=tuple(errors),
        rotation_rad=tuple(math.radians(100 * e) if math.isfinite(e) else e for e in errors),
        wrong_scene=(False,) * len(errors),
        near_training_frame=(False,) * len(errors),
        seconds=1.0,
        memory_bytes=0,
        head_bytes=0,
        frames_kept=0,
    )


RUNS = runs_of(
    [
        result("sars_spdd", 0, "a_1", [0.005, 0.008, 0.02]),
        result("sars_spdd", 1, "a_1", [0.005, 0.02, 0.3]),
        result("sars_spdd", 1, "b", [0.008, math.inf, math.inf]),
    ]
)


@pytest.mark.parametrize(
    ("suite", "first", "mean"),
    [("custom", "2.0 & 2.0 & 66.7", "50.0"), ("sim", "2.0 & 2.0 & 33.3", "33.3")],
)
def test_scenes_are_rows_and_strategies_columns(suite: str, first: str, mean: str) -> None:
    lines = paper_table(RUNS, suite).splitlines()
    assert lines[2] == r"Scene & \multicolumn{3}{c}{sars\_spdd} \\"
    assert rf"a\_1 & {first} \\" in lines
    assert r"b & $\infty$ & $\infty$ & 33.3 \\" in lines
    assert lines[-4:-2] == [rf"Mean &  &  & {mean} \\", r"TFR &  &  & 33.3 \\"]
    assert len({line.count("&") for line in lines if line.endswith(r"\\")} - {1}) == 1


def test_published_numbers_are_added_for_suites_of_the_paper() -> None:
    text = paper_table(RUNS, "i7s")
    assert r"Mean, published &  &  & 74.9 \\" in text
    assert r"TFR, published &  &  & 6.7 \\" in text  # 6.65
    assert "published" not in paper_table(RUNS, "sim-7")
    other = runs_of([result("der", 1, scene, [0.01]) for scene in ("a", "b")])
    assert r"Mean, published &  &  & -- \\" in paper_table(other, "i12s")
