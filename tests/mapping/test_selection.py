"""SARS against a slow twin written from Algorithm 1, and the metric against its formula."""

import math

import numpy as np
import pytest

from evercal.mapping.selection import (
    PoseSpace,
    SarsOptions,
    select_farthest,
    select_sars,
)


def slow_distance(pa, qa, pb, qb, side, weight):
    """The paper's formula, one pair at a time."""
    dot = min(1.0, abs(sum(a * b for a, b in zip(qa, qb, strict=True))))
    return math.dist(pa, pb) / side + weight * 2.0 * math.acos(dot)


def slow_sars(distance, capacity, radius):
    """Algorithm 1, everything recomputed for every frame."""
    buffer = []
    for new in range(len(distance)):
        if buffer and min(distance[new][j] for j in buffer) < radius:
            continue
        if len(buffer) >= capacity:
            nearest = {
                j: min((distance[j][k] for k in buffer if k != j), default=math.inf)
                for j in buffer
            }
            # First of equals: older.
            buffer.remove(min(sorted(buffer), key=nearest.__getitem__))
        buffer.append(new)
    return sorted(buffer)


def upright(*x):
    """Poses along a line, without rotation."""
    n = len(x)
    return np.stack([x, np.zeros(n), np.zeros(n)], 1), np.tile([1.0, 0, 0, 0], (n, 1))


def random_walk(rng, n, step=0.05):
    positions = np.cumsum(rng.normal(size=(n, 3)) * step, axis=0)
    quaternions = np.cumsum(rng.normal(size=(n, 4)) * step, axis=0)
    quaternions[:, 0] += 1.0
    return positions, quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def grid_walk(rng, n):
    """Grid positions 1/4 apart in a box of side 1, four rotations: many ties and repeats."""
    positions = rng.integers(0, 5, size=(n, 3)) / 4.0
    positions[:2] = [[0, 0, 0], [1, 1, 1]]
    angles = rng.integers(0, 4, size=n) * 0.25
    zero = np.zeros(n)
    quaternions = np.stack([np.cos(angles / 2), np.sin(angles / 2), zero, zero], axis=1)
    return positions, quaternions * rng.choice([-1.0, 1.0], size=(n, 1))


def metric_table(positions, quaternions, weight=1.0):
    space = PoseSpace.of(positions, quaternions, weight)
    return np.stack([space.distances(i) for i in range(len(space))])


def covering_radius(poses, selected):
    return metric_table(*poses)[selected].min(0).max()


FILL = SarsOptions(fill=True)
ANY = SarsOptions(radius=0.0)


def test_metric_equals_the_formula():
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(40, 3))
    quaternions = rng.normal(size=(40, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    side = max(positions.max(axis=0) - positions.min(axis=0))
    # Length does not matter.
    table = metric_table(positions, 3.0 * quaternions, weight=0.7)
    for i in range(40):
        for j in range(40):
            slow = slow_distance(
                positions[i], quaternions[i], positions[j], quaternions[j], side, 0.7
            )
            assert table[i, j] == pytest.approx(slow, abs=1e-7)
    assert (table == table.T).all()


def test_identical_rotations_are_exactly_zero_apart():
    rng = np.random.default_rng(1)
    quaternion = rng.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    table = metric_table(
        np.zeros((3, 3)), np.stack([quaternion, -quaternion, quaternion])
    )
    assert (table == 0.0).all()


@pytest.mark.parametrize(
    "angle", [1e-12, 1e-6, 0.1, 1.0, math.pi - 1e-6, math.pi, 4.0, 6.0]
)
def test_angle_of_known_rotations(angle):
    quaternions = np.array(
        [[1, 0, 0, 0], [math.cos(angle / 2), 0, math.sin(angle / 2), 0]]
    )
    expected = min(angle, 2 * math.pi - angle)
    table = metric_table(np.zeros((2, 3)), quaternions)
    assert table[0, 1] == pytest.approx(expected, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("radius", [0.0, 0.02, 0.1, 0.3])
@pytest.mark.parametrize("capacity", [1, 2, 30, 100, 400])
@pytest.mark.parametrize("walk", [random_walk, grid_walk])
def test_sars_equals_slow_twin(walk, capacity, radius):
    positions, quaternions = walk(np.random.default_rng(2), 300)
    poses = (positions, quaternions)
    selected = select_sars(*poses, capacity, SarsOptions(radius=radius))
    table = metric_table(*poses).tolist()
    assert selected.tolist() == slow_sars(table, capacity, radius)


@pytest.mark.parametrize("seed", range(5))
def test_sars_equals_slow_twin_for_a_camera_that_stops_and_returns(seed):
    rng = np.random.default_rng(seed)
    positions, quaternions = grid_walk(rng, 25)
    visits = np.repeat(rng.integers(0, 25, size=60), 5)
    poses = (positions[visits], quaternions[visits])
    table = metric_table(*poses).tolist()
    for capacity in (5, 20, 40):
        selected = select_sars(*poses, capacity, ANY)
        assert selected.tolist() == slow_sars(table, capacity, 0.0)


@pytest.mark.parametrize("radius", [0.0, 0.25, 0.5])
def test_sars_equals_twin_with_the_formula_of_the_paper(radius):
    """Nothing shared with the code: dyadic positions and one rotation make every tie exact."""
    positions, _ = grid_walk(np.random.default_rng(3), 300)
    still = [1.0, 0.0, 0.0, 0.0]
    table = [
        [slow_distance(a, still, b, still, 1.0, 1.0) for b in positions.tolist()]
        for a in positions.tolist()
    ]
    options = SarsOptions(radius=radius)
    selected = select_sars(positions, np.tile(still, (300, 1)), 40, options)
    assert selected.tolist() == slow_sars(table, 40, radius)


def test_older_of_the_closest_pair_leaves():
    assert select_sars(*upright(0, 0.1, 0.5, 1), 3, ANY).tolist() == [1, 2, 3]


@pytest.mark.parametrize("scale", [1.0, 64.0])
def test_distance_equal_to_radius_is_accepted_and_scale_does_not_matter(scale):
    poses = upright(0, 0.25 * scale, 0.5 * scale, scale)
    assert select_sars(*poses, 9).tolist() == [0, 2, 3]


def test_selected_frames_are_a_radius_apart_and_cover_the_scene():
    poses = random_walk(np.random.default_rng(4), 400)
    selected = select_sars(*poses, 400, SarsOptions(radius=0.5))
    table = metric_table(*poses)[np.ix_(selected, selected)]
    assert 1 < len(selected) < 400
    assert table[~np.eye(len(selected), dtype=bool)].min() >= 0.5
    assert covering_radius(poses, selected) < 0.5


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("capacity", [0, 1, 2, 37, 300, 500])
def test_fill_selects_exactly_the_capacity(seed, capacity):
    poses = random_walk(np.random.default_rng(seed), 300)
    selected = select_sars(*poses, capacity, FILL)
    assert len(selected) == len(set(selected.tolist())) == min(capacity, 300)


def test_fill_on_a_line():
    """Eleven frames 0.1 apart, in order: three fit at r <= 0.5, four at r <= 0.3."""
    line = upright(*np.arange(11.0))
    assert select_sars(*line, 3, FILL).tolist() == [0, 5, 10]
    assert select_sars(*line, 4, FILL).tolist() == [0, 3, 6, 9]


def test_fill_with_repeats_selects_every_pose():
    rng = np.random.default_rng(6)
    positions, quaternions = random_walk(rng, 12)
    visits = np.concatenate([np.arange(12), rng.integers(0, 12, size=288)])
    poses = (positions[visits], quaternions[visits])
    selected = select_sars(*poses, 30, FILL)
    assert len(selected) == 30
    assert set(visits[selected]) == set(range(12))
    assert covering_radius(poses, selected) == 0.0


def test_fill_covers_better_than_the_fixed_radius():
    poses = random_walk(np.random.default_rng(7), 1000, step=0.01)
    fixed = select_sars(*poses, 100)
    filled = select_sars(*poses, 100, FILL)
    assert len(fixed) < 100 == len(filled)
    assert covering_radius(poses, filled) < 0.7 * covering_radius(poses, fixed)


def test_farthest_equals_slow_twin():
    poses = grid_walk(np.random.default_rng(9), 80)
    table = metric_table(*poses).tolist()
    expected = [0]
    while len(expected) < 20:
        rest = [i for i in range(80) if i not in expected]
        expected.append(max(rest, key=lambda i: min(table[i][j] for j in expected)))
    assert select_farthest(*poses, 20).tolist() == sorted(expected)


def test_farthest_selects_repeats_last():
    assert select_farthest(*upright(*np.zeros(5)), 9).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(("capacity", "expected"), [(3, [1, 2, 3]), (2, [1, 3])])
def test_farthest_selects_its_start(capacity, expected):
    selected = select_farthest(*upright(0, 1, 3, 9, 10), capacity, start=[1, 3])
    assert selected.tolist() == expected


def test_scene_without_frames():
    empty = np.zeros((0, 3)), np.zeros((0, 4))
    assert select_sars(*empty, 5).size == 0
    assert select_sars(*empty, 5, FILL).size == 0
    assert select_farthest(*empty, 5).size == 0


@pytest.mark.parametrize(
    ("positions", "quaternions", "capacity", "message"),
    [
        (np.zeros((4, 2)), np.ones((4, 4)), 2, r"\(4, 2\)"),
        (np.zeros((4, 3)), np.ones((3, 4)), 2, r"\(3, 4\)"),
        (np.full((4, 3), np.nan), np.ones((4, 4)), 2, "pose 0"),
        (np.zeros((4, 3)), np.zeros((4, 4)), 2, "zero quaternion"),
        (np.zeros((4, 3)), np.ones((4, 4)), -1, "capacity is -1"),
    ],
)
def test_misuse_is_refused(positions, quaternions, capacity, message):
    with pytest.raises(ValueError, match=message):
        select_sars(positions, quaternions, capacity)


@pytest.mark.parametrize(
    ("unit", "scale"),
    [
        ("side", (4.0, 4.0, 4.0)),
        ("metre", (1.0, 1.0, 1.0)),
        ("axes", (4.0, 2.0, 1.0)),
        ("reach", (math.sqrt(5.0), math.sqrt(5.0), math.sqrt(5.0))),
        ("deviation", (2.0, 1.0, 1.0)),
    ],
)
def test_positions_are_divided_by_their_unit(unit, scale):
    """Four cameras in a plane; an axis without extent has the unit 1."""
    corners = np.array([[0.0, 0, 3], [4, 0, 3], [0, 2, 3], [4, 2, 3]])
    still = np.tile([1.0, 0, 0, 0], (4, 1))
    space = PoseSpace.of(corners, still, 1.0, unit)
    np.testing.assert_allclose(space.positions.T, corners / scale)
