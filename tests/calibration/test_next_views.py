"""Expected information of both mounts against numerical derivatives, and the greedy choice.

The information of a camera on the gripper is also compared with the conditions of Tsai and Lenz,
the choice with an exhaustive search.
"""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.from_map.next_views import (
    CAMERA_NOISE,
    GRIPPER_NOISE,
    _chosen,
    looked_at,
    next_views,
    open_position,
    wrist_information,
    wrist_jacobian,
)
from evercal.errors import InputError
from evercal.geometry import SE3

MOUNT = SE3.exp(np.array([0.05, -0.04, 0.03, 0.3, -0.2, 0.7]))
SCENE = np.array([0.5, 0.1, 0.0])


def grippers(
    count: int, turn: tuple[float, float, float] = (0.5, 0.5, 0.5), seed: int = 1
) -> SE3:
    rng = np.random.default_rng(seed)
    tangents = [
        rng.uniform(-0.3, 0.3, (count, 3)),
        rng.uniform(-1, 1, (count, 3)) * turn,
    ]
    return SE3.exp(np.concatenate(tangents, 1))


def changed(pose: SE3, step: np.ndarray) -> SE3:
    """A pose with an error in the convention of `UncertainPose`."""
    turned = pose.rotation_matrix() @ Rotation.from_rotvec(step[3:]).as_matrix()
    quaternion = Rotation.from_matrix(turned).as_quat(scalar_first=True)
    return SE3(quaternion, pose.translation_m + step[:3])


def numerical(function: object, size: int, step: float = 1e-6) -> np.ndarray:
    columns = []
    for i in range(size):
        e = step * np.eye(size)[i]
        columns.append((function(e) - function(-e)) / (2 * step))  # type: ignore[operator]
    return np.stack(columns, -1)


def test_information_is_that_of_the_residuals_under_noise_on_both_poses() -> None:
    poses = grippers(3)
    scene = SE3.from_translation(SCENE)
    noise = np.zeros((12, 12))
    noise[:6, :6] = GRIPPER_NOISE
    noise[6:, 6:] = CAMERA_NOISE
    for i, gripper in enumerate(poses):
        camera = scene.inverse() @ gripper @ MOUNT

        def residual(
            x: np.ndarray, gripper: SE3 = gripper, camera: SE3 = camera
        ) -> np.ndarray:
            moved = (gripper @ SE3.exp(x[13:19]) @ changed(MOUNT, x[:6])).inverse()
            scaled = SE3(camera.rotation_wxyz, (1 + x[12]) * camera.translation_m)
            return (moved @ scene @ SE3.exp(x[6:12]) @ scaled @ SE3.exp(x[19:])).log()

        slopes = numerical(residual, 25)
        by_unknowns = slopes[:, :13]
        by_noise = slopes[:, 13:]
        np.testing.assert_allclose(
            wrist_jacobian(poses, MOUNT, SCENE)[i], by_unknowns, atol=1e-8
        )
        expected = (
            by_unknowns.T @ np.linalg.inv(by_noise @ noise @ by_noise.T) @ by_unknowns
        )
        information = wrist_information(poses, MOUNT, SCENE)[i]
        np.testing.assert_allclose(
            information, expected, rtol=1e-4, atol=1e-5 * expected.max()
        )


@pytest.mark.parametrize(
    ("turn", "open_directions"),
    [((0, 0, 0), 3), ((0, 0, 0.6), 1), ((0.6, 0, 0.6), 0), ((0.5, 0.5, 0.5), 0)],
)
def test_rotations_about_two_axes_are_needed(
    turn: tuple[float, float, float], open_directions: int
) -> None:
    """The position of X stays open by as many directions as Tsai and Lenz state."""
    added = wrist_information(grippers(8, turn), MOUNT, SCENE).sum(0)
    # What no view decides has a standard deviation of about 30 m.
    position = np.linalg.inv(added + 1e-3 * np.eye(13))[:3, :3]
    assert int((np.linalg.eigvalsh(position) > 1.0).sum()) == open_directions


def test_the_point_looked_at_is_where_the_axes_meet() -> None:
    turned = SE3.exp(
        np.array([[0, 0, 0, 0.4, 0, 0], [0, 0, 0, 0, 0.5, 0], [0, 0, 0, -0.2, 0.1, 1]])
    )
    cameras = SE3.from_translation(SCENE) @ turned @ SE3.from_translation((0, 0, -0.7))
    np.testing.assert_allclose(looked_at(cameras), SCENE, atol=1e-2)
    parallel = SE3.from_translation([(0.0, 0, 0), (0.2, 0, 0)])
    np.testing.assert_allclose(looked_at(parallel), (0.1, 0, 0.5), atol=1e-6)


def test_one_view_is_the_best_one_and_two_are_nearly_the_best_two() -> None:
    used = grippers(2)
    reachable = grippers(12, seed=2)
    known = 1e-2 * np.eye(13) + wrist_information(used, MOUNT, SCENE).sum(0)
    added = wrist_information(reachable, MOUNT, SCENE)

    def cost(index: tuple[int, ...]) -> float:
        variances = np.diag(np.linalg.inv(known + added[list(index)].sum(0)))
        return float(variances[:3].sum() + 0.09 * variances[3:6].sum())

    chosen = _chosen(known, added, reachable, 2, used)
    assert chosen.index[0] == min(range(12), key=lambda i: cost((i,)))
    pairs = sorted(map(cost, itertools.combinations(range(12), 2)))
    assert cost(tuple(chosen.index.tolist())) <= pairs[len(pairs) // 10]
    after = np.linalg.inv(known + added[chosen.index].sum(0))
    assert chosen.sigma_mm[-1] == pytest.approx(
        1000 * np.sqrt(np.diag(after)[:3].mean())
    )
    assert chosen.sigma_deg[-1] == pytest.approx(
        np.rad2deg(np.sqrt(np.diag(after)[3:6].mean()))
    )


def test_recorded_and_excluded_poses_and_their_twins_are_not_proposed() -> None:
    used = grippers(4)
    nudge = SE3.exp(np.array([0.003, 0, 0, 0, 0.01, 0]))
    reachable = SE3.stack([*used, *(used @ nudge), *grippers(2, seed=2)])
    assert sorted(next_views(used, reachable, 10).index) == [8, 9]
    found = next_views(used, reachable, 10, excluded=SE3.stack([*used, reachable[8]]))
    assert found.index.tolist() == [9]
    with pytest.raises(InputError, match="no reachable poses"):
        next_views(used, SE3.identity((0,)))


@pytest.mark.parametrize("mount", [MOUNT, None])
def test_an_orbit_leaves_the_distance_open_and_other_distances_close_it(
    mount: SE3 | None,
) -> None:
    """The images show neither the scale of the scene nor, therefore, how far the camera is."""
    turns = SE3.exp(
        np.pad(0.3 * np.random.default_rng(0).normal(size=(20, 3)), ((0, 0), (3, 0)))
    )
    near, far = (
        SE3.from_translation(SCENE)
        @ turns
        @ SE3.from_translation((0, 0, -z))
        @ MOUNT.inverse()
        for z in (0.5, 0.8)
    )
    found = open_position(near, mount)
    assert found is not None
    # Without a mount, the distance is that of the gripper.
    ahead = MOUNT.apply([0, 0, 0.5]) - (0 if mount is None else MOUNT.translation_m)
    assert abs(ahead @ found.direction) > 0.99 * np.linalg.norm(ahead)
    assert found.sigma_mm > 5 * found.across_mm
    assert found.then_mm < 0.5 * found.sigma_mm
    assert found.motion in found.sentence()
    assert f"{2 * found.then_mm:.1f} mm" in found.sentence(2 * found.sigma_mm)
    assert open_position(SE3.stack([*near, *far]), mount) is None
    assert open_position(near[:4], mount) is None
