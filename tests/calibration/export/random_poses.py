"""Random calibrations to export, and a quaternion formula of its own."""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.geometry import SE3, Camera
from evercal.robot.frame_names import FrameNames
from evercal.robot.mount import MountName
from evercal.typing import Array

POSE = SE3.exp([0.9, -0.1, 0.5, -1.5, 0.6, 0.4])
CAMERA = Camera(640, 480, 600.25, 601.5, 319.75, 240.5, (0.1, -0.2, 0.001, 0.002, 0.03))


def calibration_of(
    pose: SE3, mount: MountName = "eye_to_hand", camera: Camera | None = CAMERA
) -> Calibration:
    """Return a calibration with typical frame names and three images, one of them unused."""
    names = FrameNames("base_link", "tool0", "cam/optical-frame")
    images = (
        ImageUse("a.png", True),
        ImageUse("b.png", False, "blurred"),
        ImageUse("c.png", True),
    )
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-8, 2e-8, 3e-8])
    return Calibration(mount, pose, covariance, names, camera, images)


def poses() -> st.SearchStrategy[SE3]:
    """Draw any pose, and often one at gimbal lock or with a rotation of 180 degrees."""
    number = st.floats(-3, 3, allow_subnormal=False)
    unit = st.floats(-1, 1, allow_subnormal=False)
    quaternions = st.tuples(unit, unit, unit, unit).filter(
        lambda q: sum(v * v for v in q) > 1e-3
    )
    special = st.sampled_from(
        [
            (1.0, 0.0, 0.0, 0.0),
            (0.0, 1.0, 0.0, 0.0),
            (0.0, 0.0, -1.0, 0.0),
            (0.5, -0.5, 0.5, -0.5),
            (0.5**0.5, 0.0, 0.5**0.5, 0.0),
            (0.6, 0.0, -0.8, 0.0),
        ]
    )
    return st.builds(
        lambda q, t: SE3(np.array(q), np.array(t)),
        st.one_of(quaternions, special),
        st.tuples(number, number, number),
    )


def random_poses(count: int = 5, seed: int = 3) -> SE3:
    """Return poses of a gripper or of a board."""
    rng = np.random.default_rng(seed)
    return SE3(rng.normal(size=(count, 4)), rng.uniform(0.2, 0.8, (count, 3)))


def quaternion_matrix(
    x: float, y: float, z: float, w: float, translation: ArrayLike
) -> Array:
    """Return a 4x4 matrix by the textbook formula."""
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = np.asarray(translation)
    return matrix
