"""The packaged rooms are those of suite sim-mini."""

import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings.samples import SampleRoom, sample_rooms
from evercal.simulation.panda_arm import base_from_flange
from rooms.changed import changed_room
from rooms.panda import panda_meshes
from rooms.paths import changed_shots
from rooms.renderer import Renderer
from rooms.room import Room, room
from rooms.suites import SUITES

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")


@pytest.fixture(scope="module")
def packaged() -> SampleRoom:
    return sample_rooms()[1]


@pytest.fixture(scope="module")
def simulated() -> Room:
    return room(*SUITES["sim-mini"].rooms[1][1:])


def poses(frames: tuple) -> SE3:
    return SE3.stack([frame.base_from_camera for frame in frames])


def test_paths_are_those_of_the_simulator(
    packaged: SampleRoom, simulated: Room
) -> None:
    assert packaged.changed is not None
    shots = changed_shots(
        changed_room(simulated, 0), 20, poses(packaged.scene.train), seed=0
    )
    expected = [shot.base_from_camera.matrix() for shot in shots]
    np.testing.assert_allclose(
        poses(packaged.changed.test).matrix(), expected, atol=1e-6
    )
    for frame in packaged.scene.test:
        assert frame.base_from_gripper is not None
        gripper = base_from_flange(np.array(frame.joints_rad))
        assert max(pose_distance(frame.base_from_gripper, gripper)) < 1e-6


def test_a_packaged_image_is_rendered_again(
    packaged: SampleRoom, simulated: Room
) -> None:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    frame = packaged.scene.test[5]
    assert frame.base_from_camera is not None
    renderer = Renderer(simulated.meshes() + panda_meshes(np.array(frame.joints_rad)))
    shifted = frame.base_from_camera @ SE3.from_translation((0.01, 0, 0))
    full = frame.camera
    middle = Camera(96, 72, full.fx, full.fy, full.cx - 112, full.cy - 84)
    image = frame.read_image()[84 : 84 + 72, 112 : 112 + 96].astype(float)
    right, wrong = (
        np.abs(renderer.render(middle, pose) - image).mean()
        for pose in (frame.base_from_camera, shifted)
    )
    assert right < 6
    assert wrong > 1.5 * right
