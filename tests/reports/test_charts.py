"""Charts hold the numbers they were given; pixels are only checked to be a picture."""

import itertools
import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from evercal.reports import (
    accuracy_against_size,
    charts,
    error_curve,
    forgetting_curves,
    kept_places,
    scene_bars,
    trajectory,
)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures drawn, so that their lines can be read."""
    made: list[Figure] = []
    original = charts.new_figure

    def keep(width: float, height: float) -> Figure:
        made.append(original(width, height))
        return made[-1]

    monkeypatch.setattr(charts, "new_figure", keep)
    return made


def is_picture(data: bytes) -> bool:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return image is not None and min(image.shape[:2]) > 200 and image.std() > 1


def test_each_panel_starts_when_its_scene_is_learned(figures: list[Figure]) -> None:
    matrix = np.array([[90.0, np.nan, np.nan], [80.0, 70.0, np.nan], [60.0, 50.0, 40.0]])
    data = forgetting_curves({"ours": matrix, "other": matrix / 2}, ["a", "b", "c"])
    assert is_picture(data)
    first, second, third, mean = figures[0].axes
    assert [panel.get_title() for panel in figures[0].axes[:3]] == ["a", "b", "c"]
    np.testing.assert_array_equal(
        np.array(first.lines[0].get_xydata()), [[1, 90], [2, 80], [3, 60]]
    )
    np.testing.assert_array_equal(np.array(second.lines[1].get_xydata()), [[2, 35], [3, 25]])
    np.testing.assert_array_equal(np.array(third.lines[0].get_xydata()), [[3, 40]])
    np.testing.assert_array_equal(np.array(mean.lines[0].get_ydata()), [90, 75, 50])
    colours = {line.get_color() for line in mean.lines}
    assert len(colours) == len({str(line.get_marker()) for line in mean.lines}) == 2


@pytest.mark.parametrize("count", [1, 5])
def test_any_number_of_scenes_has_its_panels(figures: list[Figure], count: int) -> None:
    forgetting_curves({"m": np.full((count, count), 50.0)}, [str(i) for i in range(count)])
    assert sum(panel.get_visible() for panel in figures[0].axes) == count + 1


def test_bars_stand_beside_each_other_and_as_high_as_told(figures: list[Figure]) -> None:
    data = scene_bars({"ours": [90.0, 80.0, 70.0], "other": [10.0, 20.0, 30.0]}, ["a", "b", "c"])
    assert is_picture(data)
    bars = [bar for group in figures[0].axes[0].containers for bar in group]  # pyright: ignore[reportGeneralTypeIssues]
    assert [bar.get_height() for bar in bars] == [90, 80, 70, 10, 20, 30]
    left = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars)
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(left))
    with pytest.raises(ValueError, match="3 scenes need as many numbers"):
        scene_bars({"ours": [1.0]}, ["a", "b", "c"])


def test_a_point_for_every_method(figures: list[Figure]) -> None:
    two = {"ours": (3.2, 80.0), "all": (40.0, 85.0)}
    assert is_picture(accuracy_against_size(two, "memory"))
    # Without a size there is no point, and the others keep their colours.
    assert accuracy_against_size(two | {"joint": (math.nan, 90.0)}, "memory") == (
        accuracy_against_size(two, "memory")
    )
    first = {"joint": (math.nan, 90.0)} | two
    assert accuracy_against_size(first, "memory") != accuracy_against_size(two, "memory")
    axes = figures[0].axes[0]
    points = [tuple(np.array(line.get_xydata())[0]) for line in axes.lines]
    assert points == [(3.2, 80.0), (40.0, 85.0)]
    assert axes.get_xlabel() == "memory (MB)"


def test_every_kept_place_is_a_point_of_its_panel(figures: list[Figure]) -> None:
    rng = np.random.default_rng(0)
    places = {"ours": rng.normal(size=(9, 3)), "all": rng.normal(size=(4, 3)) + 5}
    assert is_picture(kept_places(places))
    assert [axes.get_title() for axes in figures[0].axes] == ["ours (9)", "all (4)"]
    first, second = figures[0].axes
    assert first.get_xlim() == second.get_xlim()  # places can be compared between panels
    with pytest.raises(ValueError, match="one method or more"):
        kept_places({})
    with pytest.raises(ValueError, match=r"\(3, 2\)"):
        kept_places({"flat": np.zeros((3, 2))})


def test_the_error_curve_counts_frames_without_a_pose_as_never(figures: list[Figure]) -> None:
    errors = [0.01, np.inf, 0.03, 0.5]
    assert is_picture(error_curve({"ours": errors}, limit_cm=20))
    curve = figures[0].axes[0].lines[0]
    assert curve.get_drawstyle() == "steps-post"  # a share is reached at the error, not before
    x, y = np.array(curve.get_xydata()).T
    np.testing.assert_allclose(x, [0, 1, 3, 20])
    np.testing.assert_allclose(y, [0, 25, 50, 50])


def test_the_trajectory_counts_what_it_does_not_show(figures: list[Figure]) -> None:
    truth = np.stack([np.linspace(0, 1, 6), np.linspace(5, 6, 6), np.zeros(6)], axis=1)
    estimated = truth + 0.01
    estimated[1] += 50.0
    estimated[2] = np.nan
    ok = np.array([True, True, False, True, True, True])
    assert is_picture(trajectory(truth, estimated, ok, axes=(0, 2)))
    labels = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert labels == ["true (6)", "found (5)", "not found (1)", "found outside this view (1)"]
    panel = figures[0].axes[0]
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("x (m)", "z (m)")
    assert panel.get_xlim()[1] < 2.0


def test_recordings_are_not_joined_by_a_line(figures: list[Figure]) -> None:
    one = np.stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)], axis=1)
    truth = np.concatenate([one, one + np.array([0, 3, 0])])
    trajectory(truth, truth, np.ones(40, bool))
    y = np.array(figures[0].axes[0].lines[0].get_ydata())
    assert np.flatnonzero(np.isnan(y)).tolist() == [20]
    still = np.zeros((3, 3))
    assert is_picture(trajectory(still, still, np.zeros(3, bool)))


def test_the_same_numbers_give_the_same_bytes() -> None:
    assert error_curve({"a": [0.01]}) == error_curve({"a": [0.01]})


def test_misuse_is_refused() -> None:
    with pytest.raises(ValueError, match=r"m: 2 scenes need \(2, 2\)"):
        forgetting_curves({"m": np.zeros((3, 3))}, ["a", "b"])
    with pytest.raises(ValueError, match="m: errors"):
        error_curve({"m": []})
    with pytest.raises(ValueError, match="m: errors"):
        error_curve({"m": [np.nan]})
    with pytest.raises(ValueError, match="truth and estimates"):
        trajectory(np.zeros((2, 3)), np.zeros((3, 3)), np.ones(2, bool))


def test_drawing_loads_its_libraries_late_and_never_pyplot() -> None:
    code = (
        "import sys, evercal.reports as d;"
        " print('matplotlib' in sys.modules, 'cv2' in sys.modules);"
        " d.error_curve({'a': [0.01]}); print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() == ["False", "False", "False"]
