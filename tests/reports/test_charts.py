"""Charts contain the given numbers."""

import math
import subprocess
import sys
from collections.abc import Callable
from types import ModuleType

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from evercal.reports import charts
from evercal.reports.charts import error_curve, error_histogram, trajectory


@pytest.fixture
def figures(figures_of: Callable[[ModuleType], list[Figure]]) -> list[Figure]:
    return figures_of(charts)


def is_picture(data: bytes) -> bool:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return image is not None and min(image.shape[:2]) > 200 and image.std() > 1


def test_error_curve_ends_below_100_percent_without_all_poses(figures: list[Figure]) -> None:
    assert is_picture(error_curve({"ours": [0.01, np.inf, 0.03, 0.5]}, limit_mm=200))
    curve = figures[0].axes[0].lines[0]
    assert curve.get_drawstyle() == "steps-post"
    x, y = np.array(curve.get_xydata()).T
    np.testing.assert_allclose(x, [0, 10, 30, 200])
    np.testing.assert_allclose(y, [0, 25, 50, 50])


def test_histogram_counts_every_frame(figures: list[Figure]) -> None:
    groups = {"a": [0.0, 0.0012, 0.0019, 0.0039, 0.004, 3.0, math.inf], "b": [0.0021]}
    assert is_picture(error_histogram(groups, 4.0, 4))
    (figure,) = figures
    bars = [{p.get_x(): p.get_height() for p in panel.patches} for panel in figure.axes]  # pyright: ignore[reportAttributeAccessIssue]
    # Millimetres; one separate bar counts errors of 4 mm or more and missing poses.
    assert bars == [{0: 1, 1: 2, 2: 0, 3: 1, 5: 3}, {0: 0, 1: 0, 2: 1, 3: 0}]
    assert [panel.get_title() for panel in figure.axes] == ["a (7)", "b (1)"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["3 larger\nor no pose"]


@pytest.mark.parametrize("chart", [error_curve, error_histogram])
@pytest.mark.parametrize("errors", [[], [math.nan]])
def test_empty_and_nan_errors_are_refused(chart: type, errors: list[float]) -> None:
    with pytest.raises(ValueError, match="m: errors"):
        chart({"m": errors})


def test_trajectory_counts_estimates_outside_the_plot(figures: list[Figure]) -> None:
    truth = np.stack([np.linspace(0, 1, 6), np.zeros(6), np.linspace(5, 6, 6)], axis=1)
    estimated = truth + 0.01
    estimated[1] += 50.0
    estimated[2] = np.nan
    assert is_picture(trajectory(truth, estimated))
    labels = [text.get_text() for text in figures[0].legends[0].get_texts()]
    assert labels == [
        "true (6)",
        "estimated (5)",
        "no pose (1)",
        "estimated outside this plot (1)",
    ]
    panel = figures[0].axes[0]
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("x (m)", "z (m)")
    assert panel.get_xlim()[1] < 2.0


def test_trajectories_of_several_recordings_are_not_connected(figures: list[Figure]) -> None:
    first = np.stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)], axis=1)
    truth = np.concatenate([first, first + np.array([0, 3, 0])])
    trajectory(truth, truth)
    y = np.array(figures[0].axes[0].lines[0].get_ydata())
    assert np.flatnonzero(np.isnan(y)).tolist() == [20]
    still = np.zeros((3, 3))
    assert is_picture(trajectory(still, np.full((3, 3), np.nan)))


def test_equal_numbers_give_equal_bytes() -> None:
    assert error_curve({"a": [0.01]}) == error_curve({"a": [0.01]})


def test_heavy_libraries_are_imported_late_and_pyplot_never() -> None:
    code = (
        "import sys, evercal.reports.charts as charts, evercal.reports.overlay;"
        " print('matplotlib' in sys.modules, 'cv2' in sys.modules);"
        " charts.error_curve({'a': [0.01]}); print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() == ["False", "False", "False"]
