"""Charts of a calibration contain the given numbers."""

from collections.abc import Callable
from types import ModuleType

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from evercal.reports import calibration_charts
from evercal.reports.calibration_charts import (
    ellipsoid_outline,
    ellipsoid_projections,
    error_terms,
    residual_bars,
)


@pytest.fixture
def figures(figures_of: Callable[[ModuleType], list[Figure]]) -> list[Figure]:
    return figures_of(calibration_charts)


def is_picture(data: bytes) -> bool:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return image is not None and min(image.shape[:2]) > 100 and image.std() > 1


def some_covariance(seed: int = 3) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(3, 3))
    return root @ root.T


def heights(figure: Figure, panel: int, along: str = "height") -> list[float]:
    bars = [p for p in figure.axes[panel].patches if isinstance(p, Rectangle)]
    return [getattr(bar, f"get_{along}")() for bar in bars]


@pytest.mark.parametrize("plane", [(0, 1), (0, 2), (1, 2)])
def test_outline_is_the_projection_of_the_ellipsoid(plane: tuple[int, int]) -> None:
    covariance = some_covariance()
    rng = np.random.default_rng(0)
    # Points of the surface: 95 % of three-dimensional Gaussian errors have a squared length of
    # at most 7.815 (tables of chi squared).
    ball = rng.normal(size=(200_000, 3))
    ball *= np.sqrt(7.814728) / np.linalg.norm(ball, axis=1, keepdims=True)
    surface = (ball @ np.linalg.cholesky(covariance).T)[:, plane]
    outline = ellipsoid_outline(covariance, plane, 0.95)
    for angle in np.linspace(0, np.pi, 7):
        along = np.array([np.cos(angle), np.sin(angle)])
        assert (outline @ along).max() == pytest.approx((surface @ along).max(), rel=2e-3)


def test_projections_share_one_scale_and_name_their_axes(figures: list[Figure]) -> None:
    assert is_picture(ellipsoid_projections(some_covariance(), "panda_link0"))
    panels = figures[0].axes
    assert [p.get_xlabel() for p in panels] == [f"{a} of panda_link0 (mm)" for a in "xxy"]
    assert [p.get_ylabel() for p in panels] == [f"{a} of panda_link0 (mm)" for a in "yzz"]
    assert len({(p.get_xlim(), p.get_ylim()) for p in panels}) == 1
    reach = np.sqrt(7.814728 * np.diag(some_covariance()))
    low, high = panels[0].get_xlim()
    assert high > reach.max()
    assert low == -high


def test_zero_errors_and_special_characters_are_drawn() -> None:
    assert is_picture(ellipsoid_projections(np.zeros((3, 3)), r"a$\frac$b"))
    assert is_picture(error_terms([r"$x_{$", "基座"], [0, 1], [0, 1]))


def test_each_term_has_a_bar(figures: list[Figure]) -> None:
    names = ["landmarks and lens, shared by all images from this spot", "scatter", "all together"]
    assert is_picture(error_terms(names, [0.64, 0.07, 0.65], [0.02, 0.001, 0.021]))
    assert heights(figures[0], 0, "width") == [0.64, 0.07, 0.65]
    assert heights(figures[0], 1, "width") == [0.02, 0.001, 0.021]
    labels = [text.get_text().replace("\n", " ") for text in figures[0].axes[0].get_yticklabels()]
    assert labels == names


def test_bar_of_an_outlier_is_cut(figures: list[Figure]) -> None:
    millimetres = [1.0, 2.0, 500.0, None]
    data = residual_bars(millimetres, [0.1, 0.2, 0.3, None], [True, True, False, False])
    assert is_picture(data)
    upper, lower = figures[0].axes
    assert heights(figures[0], 0) == [1.0, 2.0, 4.0, 0.0]  # cut at twice the largest used one
    assert [text.get_text() for text in upper.texts] == ["cut, 500"]
    assert heights(figures[0], 1) == [0.1, 0.2, 0.3, 0.0]
    assert not lower.texts
    legend = upper.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["used", "rejected"]


def test_empty_and_many_residuals_are_drawn() -> None:
    assert is_picture(residual_bars([None, None], [None, None], [False, False]))
    assert is_picture(residual_bars([0.0] * 60, [0.0] * 60, [True] * 60))
