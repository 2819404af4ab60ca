"""The histogram counts every frame once, those without a pose too."""

import math

import pytest
from matplotlib.figure import Figure

from evercal.reports import charts, error_histogram


def test_every_frame_stands_in_the_bar_of_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Figure] = []
    original = charts.new_figure

    def keep(width: float, height: float) -> Figure:
        made.append(original(width, height))
        return made[-1]

    monkeypatch.setattr(charts, "new_figure", keep)
    groups = {"a": [0.0, 0.0012, 0.0019, 0.0039, 0.004, 3.0, math.inf], "b": [0.0021]}
    assert error_histogram(groups, 4.0, 4).startswith(b"\x89PNG")
    (figure,) = made
    bars = [{p.get_x(): p.get_height() for p in panel.patches} for panel in figure.axes]  # pyright: ignore[reportAttributeAccessIssue]
    # Millimetres; from 4 mm on and without a pose they are one bar beside the others.
    assert bars == [{0: 1, 1: 2, 2: 0, 3: 1, 5: 3}, {0: 0, 1: 0, 2: 1, 3: 0}]
    assert [panel.get_title() for panel in figure.axes] == ["a (7)", "b (1)"]
    assert [text.get_text() for text in figure.axes[0].texts] == ["3 beyond\nor no pose"]


def test_nothing_and_nan_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        error_histogram({})
    with pytest.raises(ValueError, match="nan"):
        error_histogram({"a": [math.nan]})
