"""The histogram counts every frame once, those without a pose too."""

import math

import pytest

from evercal.drawing import error_histogram


def test_a_png_that_depends_on_its_numbers_alone() -> None:
    one = error_histogram({"a": [0.001, 0.002], "b": [math.inf]})
    assert one.startswith(b"\x89PNG")
    assert one == error_histogram({"a": [0.002, 0.001], "b": [9.0]})
    assert one != error_histogram({"a": [0.001, 0.003], "b": [math.inf]})


def test_nothing_and_nan_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        error_histogram({})
    with pytest.raises(ValueError, match="nan"):
        error_histogram({"a": [math.nan]})
