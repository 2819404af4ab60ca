"""Charts of a benchmark contain the given numbers."""

import itertools
import math
from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
from evercal.continual.benchmark.bench_charts import (
    accuracy_against_memory,
    forgetting_curves,
    keyframe_positions,
    scene_bars,
)
from matplotlib.figure import Figure

from evercal.continual.benchmark import bench_charts


@pytest.fixture
def figures(figures_of: Callable[[ModuleType], list[Figure]]) -> list[Figure]:
    return figures_of(bench_charts)


def test_each_panel_starts_when_its_scene_is_learned(figures: list[Figure]) -> None:
    matrix = np.array([[90.0, np.nan, np.nan], [80.0, 70.0, np.nan], [60.0, 50.0, 40.0]])
    forgetting_curves({"ours": matrix, "other": matrix / 2}, ["a", "b", "c"])
    first, second, third, mean = figures[0].axes
    assert [panel.get_title() for panel in figures[0].axes[:3]] == ["a", "b", "c"]
    points = [[1, 90], [2, 80], [3, 60]]
    np.testing.assert_array_equal(np.array(first.lines[0].get_xydata()), points)
    np.testing.assert_array_equal(np.array(second.lines[1].get_xydata()), [[2, 35], [3, 25]])
    np.testing.assert_array_equal(np.array(third.lines[0].get_xydata()), [[3, 40]])
    np.testing.assert_array_equal(np.array(mean.lines[0].get_ydata()), [90, 75, 50])
    colours = {line.get_color() for line in mean.lines}
    assert len(colours) == len({str(line.get_marker()) for line in mean.lines}) == 2


@pytest.mark.parametrize("count", [1, 5])
def test_every_scene_has_a_panel(figures: list[Figure], count: int) -> None:
    forgetting_curves({"m": np.full((count, count), 50.0)}, [str(i) for i in range(count)])
    assert sum(panel.get_visible() for panel in figures[0].axes) == count + 1


def test_bars_have_the_given_heights_and_do_not_overlap(figures: list[Figure]) -> None:
    scene_bars({"ours": [90.0, 80.0, 70.0], "other": [10.0, 20.0, 30.0]}, ["a", "b", "c"])
    bars = [bar for group in figures[0].axes[0].containers for bar in group]  # pyright: ignore[reportGeneralTypeIssues]
    assert [bar.get_height() for bar in bars] == [90, 80, 70, 10, 20, 30]
    left = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars)
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(left))


def test_methods_without_a_size_have_no_point(figures: list[Figure]) -> None:
    methods = {"joint": (math.nan, 90.0), "ours": (3.2, 80.0), "all": (40.0, 85.0)}
    accuracy_against_memory(methods)
    panel = figures[0].axes[0]
    points = [tuple(np.array(line.get_xydata())[0]) for line in panel.lines]
    assert points == [(3.2, 80.0), (40.0, 85.0)]
    # A method has the same colour in all charts.
    assert [line.get_color() for line in panel.lines] == list(bench_charts.COLOURS[1:3])


def test_keyframe_panels_share_their_limits(figures: list[Figure]) -> None:
    rng = np.random.default_rng(0)
    keyframe_positions({"ours": rng.normal(size=(9, 3)), "all": rng.normal(size=(4, 3)) + 5})
    first, second = figures[0].axes
    assert [first.get_title(), second.get_title()] == ["ours (9)", "all (4)"]
    assert first.get_xlim() == second.get_xlim()
