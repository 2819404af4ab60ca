"""The arm's meshes against its URDF, read by yourdfpy."""

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.simulation.panda_arm import HIGH_RAD, LOW_RAD, base_from_flange
from rooms import panda

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")

yourdfpy = pytest.importorskip("yourdfpy", reason="the extra 'urdf' is not installed")
pytest.importorskip("collada", reason="pycollada is not installed")


def test_meshes_and_flange_are_where_the_urdf_has_them() -> None:
    robot = panda.robots_folder() / "panda_description"

    def on_disk(fname: str) -> str:
        return str(robot / fname.rpartition("panda_description/")[2])

    urdf = yourdfpy.URDF.load(str(robot / "urdf/panda.urdf"), filename_handler=on_disk)
    for joints in np.random.default_rng(0).uniform(LOW_RAD, HIGH_RAD, (3, 7)):
        urdf.update_cfg(np.append(joints, 0.03))
        flange = SE3.from_matrix(urdf.get_transform("panda_link8", "panda_link0"))
        assert max(pose_distance(base_from_flange(joints), flange)) < 1e-9
        points = np.concatenate(
            [mesh.vertices_m for mesh, _ in panda.panda_meshes(joints)]
        )
        expected = urdf.scene.to_geometry().vertices
        assert len(points) == len(expected)
        for part in (np.min, np.max, np.mean, np.std):
            np.testing.assert_allclose(part(points, 0), part(expected, 0), atol=1e-9)
