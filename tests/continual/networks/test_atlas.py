"""Cells of the atlas: no overlap, each contains its scene."""

import math
from fractions import Fraction

import numpy as np
import pytest

from evercal.continual.networks.atlas import (
    Atlas,
    Cell,
    combined_centres,
    paper_grid,
    spiral,
)
from evercal.errors import InputError


def random_scene(rng: np.random.Generator) -> np.ndarray:
    """Draw (n, 3) camera positions of a scene of 3 cm to 50 m, anywhere in its base frame."""
    span = 10.0 ** rng.uniform(-1.5, 1.7, 3)
    return rng.uniform(-1, 1, (int(rng.integers(1, 40)), 3)) * span + rng.normal(
        0, 30, 3
    )


def filled(seed: int, count: int) -> tuple[Atlas, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    atlas = Atlas()
    scenes = [random_scene(rng) for _ in range(count)]
    for scene in scenes:
        atlas.place(scene)
    return atlas, scenes


def overlap(a: Cell, b: Cell) -> float:
    """Compute the common area of two cells, square metres."""
    sides = [
        min(a.centre_m[k] + a.side_m / 2, b.centre_m[k] + b.side_m / 2)
        - max(a.centre_m[k] - a.side_m / 2, b.centre_m[k] - b.side_m / 2)
        for k in range(2)
    ]
    return max(sides[0], 0.0) * max(sides[1], 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_cell_contains_the_cameras_of_its_scene(seed: int) -> None:
    atlas, scenes = filled(seed, 8)
    for i, (cell, scene) in enumerate(zip(atlas.cells, scenes, strict=True)):
        in_atlas = cell.atlas_from_base.apply(scene)
        for position in in_atlas:
            inside = [c.distance_m(position) <= c.side_m / 2 for c in atlas.cells]
            assert inside == [other == i for other in range(len(scenes))]
        # A translation that moves the mean camera to the centre.
        np.testing.assert_array_equal(cell.atlas_from_base.rotation_wxyz, [1, 0, 0, 0])
        np.testing.assert_allclose(in_atlas.mean(0), cell.centre_m, atol=1e-9)
        np.testing.assert_allclose(in_atlas - in_atlas[0], scene - scene[0], atol=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_scene_gets_the_first_free_point_of_the_spiral(seed: int) -> None:
    """Its cell, of at least 5 m, overlaps no other."""
    atlas, scenes = filled(seed, 12)
    for i, scene in enumerate(scenes):
        side = max(
            5.0, 2 * max(scene[:, k].max() - scene[:, k].min() for k in range(3))
        )
        places = (
            Cell((float(x), float(y), 0.0), side, (0.0, 0.0, 0.0))
            for x, y, _ in spiral()
        )
        wanted = next(
            place
            for place in places
            if all(overlap(place, cell) < 1e-9 for cell in atlas.cells[:i])
        )
        assert atlas.cells[i].centre_m == wanted.centre_m
        assert atlas.cells[i].side_m == pytest.approx(side)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7, 9, 10, 12, 16, 17, 19, 30])
def test_paper_grid_follows_glace(count: int) -> None:
    g = next(g for g in range(1, 100) if g * g >= count)
    expected = [
        (-5 * (math.ceil(Fraction(i + 1, g)) - 1), -5 * (i % g), 0)
        for i in range(count)
    ]
    grid = paper_grid(count)
    assert [tuple(row) for row in grid] == expected
    assert len(set(expected)) == count
    atlas = Atlas(count)
    for i in range(count):
        cell = atlas.place(np.array([[0.0, 0, 0], [3, 3, 3]]))
        assert cell.centre_m == expected[i]
    with pytest.raises(InputError, match=f"{count} scenes"):
        atlas.place(np.zeros((1, 3)))


@pytest.mark.parametrize("seed", range(3))
def test_combined_centres_lie_among_the_cameras(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scenes = [
        rng.uniform(-1, 1, (n, 3)) + rng.normal(0, 30, 3) for n in (30, 3, 40, 25, 20)
    ]
    centres = np.array(combined_centres(scenes, 15, seed))
    assert len(centres) == 15
    assert combined_centres(scenes, 15, seed) == tuple(map(tuple, centres))
    atlas = Atlas(len(scenes))
    shares = []
    for positions in scenes:
        in_atlas = atlas.place(positions).atlas_from_base.apply(positions)
        # Scenes are 5 m apart and 2 m wide, so each centre is a mean of one scene's cameras.
        inside = (centres >= in_atlas.min(0) - 1e-9) & (
            centres <= in_atlas.max(0) + 1e-9
        )
        shares.append(inside.all(1).sum())
    assert sum(shares) == 15
    assert min(shares) >= 1
    np.testing.assert_array_equal([c.centre_m for c in atlas.cells], paper_grid(5))
