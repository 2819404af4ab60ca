"""Forward kinematics of the Panda against its published DH table."""

import numpy as np
import pytest

from evercal.simulation.furnished.panda import HOME_RAD, Panda

pytest.importorskip("yourdfpy", reason="the extra 'sim' is not installed")

# Craig's convention: a, d, alpha of joints 1 to 7, then the flange (Franka's documentation).
DH = [
    (0, 0.333, 0),
    (0, 0, -np.pi / 2),
    (0, 0.316, np.pi / 2),
    (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0, 0, np.pi / 2),
    (0.088, 0, np.pi / 2),
    (0, 0.107, 0),
]


def dh_flange(joints: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for (a, d, alpha), theta in zip(DH, [*joints, 0.0], strict=True):
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        pose = pose @ np.array(
            [
                [ct, -st, 0, a],
                [st * ca, ct * ca, -sa, -d * sa],
                [st * sa, ct * sa, ca, d * ca],
                [0, 0, 0, 1],
            ]
        )
    return pose


def test_forward_kinematics_match_the_dh_table() -> None:
    panda = Panda(meshes=False)
    for joints in (np.zeros(7), np.array(HOME_RAD), np.linspace(-0.8, 0.9, 7)):
        ours = panda.base_from_flange(joints).matrix()
        np.testing.assert_allclose(ours, dh_flange(joints), atol=1e-6)
    with pytest.raises(ValueError, match="7 joint angles"):
        panda.base_from_flange(np.zeros(6))
