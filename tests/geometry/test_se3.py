"""Group axioms, closed forms and matrices: uniform, near the identity and near half rotations."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.linalg import expm

from evercal.geometry import SE3, average_poses, nearest_rotation, pose_distance


def random_poses(
    rng: np.random.Generator, shape: tuple[int, ...], angle: str = "any"
) -> SE3:
    axis = rng.normal(size=(*shape, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    low, high = {
        "any": (0.0, math.pi),
        "tiny": (0.0, 1e-7),
        "half_turn": (math.pi - 1e-7, math.pi),
    }[angle]
    theta = rng.uniform(low, high, size=(*shape, 1))
    quaternion = np.concatenate([np.cos(theta / 2), np.sin(theta / 2) * axis], axis=-1)
    return SE3(quaternion, rng.normal(size=(*shape, 3)))


def assert_close(a: SE3, b: SE3, tolerance: float = 1e-12) -> None:
    metres, radians = pose_distance(a, b)
    assert np.max(metres, initial=0) < tolerance
    assert np.max(radians, initial=0) < tolerance


cases = st.tuples(
    st.integers(0, 2**32 - 1), st.sampled_from(["any", "tiny", "half_turn"])
)


@given(cases)
@settings(max_examples=60)
def test_group_axioms(case: tuple[int, str]) -> None:
    seed, angle = case
    rng = np.random.default_rng(seed)
    a, b, c = (random_poses(rng, (), angle) for _ in range(3))
    assert_close((a @ b) @ c, a @ (b @ c))
    assert_close(a @ SE3.identity(), a)
    assert_close(SE3.identity() @ a, a)
    assert_close(a @ a.inverse(), SE3.identity())
    assert_close(a.inverse() @ a, SE3.identity())


@given(cases)
@settings(max_examples=60)
def test_scipy_rotations_and_back(case: tuple[int, str]) -> None:
    seed, angle = case
    poses = random_poses(np.random.default_rng(seed), (2, 3), angle)
    np.testing.assert_allclose(
        poses.rotation.as_matrix(), poses.rotation_matrix(), atol=1e-12
    )
    back = SE3.of(poses.rotation, poses.translation_m)
    assert_close(back, poses)
    assert (back.rotation_wxyz[..., 0] >= 0).all()
    kept = SE3.of(poses.rotation, poses.translation_m, canonical=False)
    np.testing.assert_allclose(kept.rotation_wxyz, poses.rotation_wxyz, atol=1e-15)


@given(cases)
@settings(max_examples=60)
def test_agrees_with_matrices(case: tuple[int, str]) -> None:
    seed, angle = case
    rng = np.random.default_rng(seed)
    a, b = (random_poses(rng, (4,), angle) for _ in range(2))
    points = rng.normal(size=(4, 3))
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-12)
    np.testing.assert_allclose(
        a.inverse().matrix(), np.linalg.inv(a.matrix()), atol=1e-12
    )
    homogeneous = np.concatenate([points, np.ones((4, 1))], axis=1)
    twin = np.einsum("nij,nj->ni", a.matrix(), homogeneous)[:, :3]
    np.testing.assert_allclose(a.apply(points), twin, atol=1e-12)
    assert_close(SE3.from_matrix(a.matrix()), a)
    assert_close(SE3.from_matrix(a.matrix()[:, :3]), a)
    # Of two quaternions the one with w >= 0 is chosen.
    assert (SE3.from_matrix(a.matrix()).rotation_wxyz[:, 0] >= 0).all()


@given(cases)
@settings(max_examples=60)
def test_log_inverts_exp(case: tuple[int, str]) -> None:
    seed, angle = case
    pose = random_poses(np.random.default_rng(seed), (3,), angle)
    assert_close(SE3.exp(pose.log()), pose, 1e-8)
    assert np.all(np.linalg.norm(pose.log()[:, 3:], axis=-1) <= math.pi + 1e-12)


def test_exp_is_the_matrix_exponential_of_translation_then_rotation() -> None:
    tangents = np.random.default_rng(0).normal(size=(20, 6))
    tangents[0, 3:] *= 1e-9
    for tangent in tangents:
        v, (x, y, z) = tangent[:3], tangent[3:]
        generator = np.zeros((4, 4))
        generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        generator[:3, 3] = v
        np.testing.assert_allclose(
            SE3.exp(tangent).matrix(), expm(generator), atol=1e-10
        )


def test_quarter_rotation_about_z_maps_x_to_y() -> None:
    half = math.sqrt(0.5)
    turned = SE3(np.array([half, 0, 0, half]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(
        turned.apply([1.0, 0.0, 0.0]), [1.0, 3.0, 3.0], atol=1e-15
    )


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 1.0, math.pi - 1e-9])
def test_pose_distance_is_exact_for_small_and_large_angles(angle: float) -> None:
    turned = SE3.exp([0, 0, 0, 0, angle, 0])
    moved = SE3(turned.rotation_wxyz, np.array([0.0, 3.0, 4.0]))
    metres, radians = pose_distance(SE3.identity(), moved)
    assert metres == pytest.approx(5.0, rel=1e-15)
    assert radians == pytest.approx(angle, rel=1e-6)
    opposite = SE3(-moved.rotation_wxyz, moved.translation_m)
    assert pose_distance(moved, opposite)[1] == pytest.approx(0.0, abs=1e-12)


def test_batches_broadcast_index_stack_and_iterate() -> None:
    rng = np.random.default_rng(1)
    poses = random_poses(rng, (2, 5))
    one = random_poses(rng, ())
    assert (one @ poses).shape == (2, 5)
    assert_close((one @ poses)[1, 3], one @ poses[1, 3])
    assert_close((poses @ one)[0], SE3.stack([pose @ one for pose in poses[0]]))
    assert len(poses) == 2
    assert poses[:, 1:3].shape == (2, 2)
    assert poses[0][np.array([True, False, True, False, False])].shape == (2,)
    points = rng.normal(size=(7, 9, 3))
    np.testing.assert_allclose(
        one.apply(points)[6, 8], one.apply(points[6, 8]), atol=1e-14
    )
    assert poses[:, :, None].apply(np.zeros((11, 3))).shape == (2, 5, 11, 3)
    assert SE3.stack([]).shape == (0,)
    assert SE3.stack([]).matrix().shape == (0, 4, 4)
    assert SE3.from_matrix(np.zeros((0, 4, 4))).inverse().shape == (0,)


def test_from_matrix_corrects_rounding_and_refuses_other_matrices() -> None:
    pose = random_poses(np.random.default_rng(2), (50,))
    printed = np.round(pose.matrix(), 4)
    mended = SE3.from_matrix(printed)
    assert_close(mended, pose, 2e-4)
    rotation = mended.rotation_matrix()
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2),
        np.tile(np.eye(3), (50, 1, 1)),
        atol=1e-12,
    )
    scaled = pose.matrix()
    scaled[7, :3, :3] *= 1.01
    with pytest.raises(ValueError, match=r"off by 0\.02"):
        SE3.from_matrix(scaled)
    with pytest.raises(ValueError, match="reflection"):
        SE3.from_matrix(np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(ValueError, match="last row"):
        SE3.from_matrix(np.diag([1.0, 1.0, 1.0, 2.0]))
    with pytest.raises(ValueError, match="finite"):
        SE3.from_matrix(np.full((4, 4), np.inf))
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        SE3.from_matrix(np.eye(3))


def test_constructor_refuses_other_shapes_and_values() -> None:
    with pytest.raises(ValueError, match="length zero"):
        SE3(np.zeros(4), np.zeros(3))
    with pytest.raises(ValueError, match=r"\(2, 4\) and \(3,\)"):
        SE3(np.ones((2, 4)), np.zeros(3))
    with pytest.raises(ValueError, match="inf or nan"):
        SE3(np.array([1.0, 0, 0, 0]), np.array([0.0, np.nan, 0.0]))
    translation = np.zeros(3)
    pose = SE3(np.array([1.0, 0, 0, 0]), translation)
    translation += 1.0  # arrays are copied
    assert pose.translation_m.tolist() == [0.0, 0.0, 0.0]


def test_average_ignores_forty_percent_of_outliers() -> None:
    rng = np.random.default_rng(3)
    truth = random_poses(rng, ())
    near = truth @ SE3.exp(rng.normal(size=(60, 6)) * 0.01)
    far = random_poses(rng, (20,)) @ SE3.exp(np.full((20, 6), 1.0))
    together = SE3(np.tile([0, 1.0, 0, 0], (20, 1)), np.full((20, 3), 1000.0))
    poses = SE3.stack([*near, *far, *together])
    metres, radians = pose_distance(average_poses(poses), truth)
    # 0.01 * sqrt(3) / sqrt(60) is 0.0022; three times that is left for chance.
    assert metres < 0.007
    assert radians < 0.007


def test_average_does_not_depend_on_the_frame_or_the_quaternion_signs() -> None:
    rng = np.random.default_rng(4)
    poses = SE3.exp(rng.normal(size=(15, 6)) * 0.1)
    signs = rng.choice([-1.0, 1.0], size=(15, 1))
    flipped = SE3(poses.rotation_wxyz * signs, poses.translation_m)
    other = random_poses(rng, ())
    assert_close(average_poses(flipped), average_poses(poses), 1e-9)
    assert_close(average_poses(other @ poses), other @ average_poses(poses), 1e-9)


def test_average_of_one_and_two_poses() -> None:
    rng = np.random.default_rng(5)
    one = random_poses(rng, (1,))
    assert_close(average_poses(one), one[0])
    step = np.array([0.2, 0, 0, 0, 0, 0.4])
    pair = SE3.stack([SE3.identity(), SE3.exp(step)])
    middle = average_poses(pair)
    assert pose_distance(middle, pair[0])[1] == pytest.approx(0.2, abs=1e-6)
    with pytest.raises(ValueError, match="n >= 1"):
        average_poses(SE3.stack([]))


def test_unit_quaternions_stay_the_same_to_the_last_bit() -> None:
    random = np.random.default_rng(0).normal(size=(1000, 4))
    once = SE3(random, np.zeros((1000, 3)))
    assert (
        SE3(once.rotation_wxyz, once.translation_m).rotation_wxyz == once.rotation_wxyz
    ).all()


def test_the_nearest_rotation_is_no_reflection() -> None:
    rng = np.random.default_rng(0)
    true = random_poses(rng, (50,)).rotation_matrix()
    near = nearest_rotation(3.0 * true)
    np.testing.assert_allclose(near, true, atol=1e-12)
    any_matrices = nearest_rotation(rng.normal(size=(50, 3, 3)))
    np.testing.assert_allclose(np.linalg.det(any_matrices), 1.0)
