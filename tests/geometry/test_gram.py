"""Inner products of rows: no matrix is multiplied by a view of itself."""

from typing import Any

import numpy as np
import pytest

from evercal.geometry.normal_equations import gram
from evercal.localization.repetition import pattern_steps


class Watched(np.ndarray):
    """A matrix that refuses a product with its own transpose."""

    def __matmul__(self, other: Any) -> Any:
        assert not np.shares_memory(self, other)
        return super().__matmul__(other)


@pytest.mark.parametrize("shape", [(5, 3), (2, 5, 3)])
def test_inner_products_are_of_a_matrix_and_a_copy(shape: tuple[int, ...]) -> None:
    rows = np.random.default_rng(0).normal(size=shape)
    expected = np.einsum("...ik,...jk->...ij", rows, rows)
    for given in (rows, np.asfortranarray(rows)):
        np.testing.assert_allclose(gram(given.view(Watched)), expected)


def test_a_pattern_is_searched_with_a_copy() -> None:
    rows = np.random.default_rng(0).normal(size=(30, 9))
    pattern_steps(rows[:, :3], rows.view(Watched), np.zeros(3))
