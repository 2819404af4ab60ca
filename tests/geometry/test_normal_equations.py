"""Normal equations of unknowns with very different units."""

import numpy as np
import pytest

from evercal.geometry.normal_equations import (
    normal_inverse,
    normal_pseudo_inverse,
    normal_solution,
)

UNITS = np.array([1e-9, 1.0, 1e7])


def normal(rank: int) -> np.ndarray:
    rows = np.random.default_rng(rank).normal(size=(rank, 3)) / UNITS
    return rows.T @ rows


def test_inverses_and_solution_agree_with_the_definition_in_any_units() -> None:
    full = normal(5)
    true = np.array([3.0, -2.0, 0.5]) * UNITS
    for inverse in (normal_inverse(full, 1e-14), normal_pseudo_inverse(full, 1e-12)):
        product = (inverse @ full) * UNITS / UNITS[:, None]
        assert product == pytest.approx(np.eye(3), abs=1e-9)
    assert normal_solution(full, full @ true) == pytest.approx(true, rel=1e-9)


def test_an_open_direction_has_a_huge_variance_or_none() -> None:
    open_direction = normal(2)
    ridged = np.linalg.eigvalsh(
        normal_inverse(open_direction, 1e-12) / np.outer(UNITS, UNITS)
    )
    cut = np.linalg.eigvalsh(
        normal_pseudo_inverse(open_direction, 1e-12) / np.outer(UNITS, UNITS)
    )
    assert ridged[-1] > 1e9
    assert abs(cut[0]) < 1e-6
    assert cut[-1] < 1e6
