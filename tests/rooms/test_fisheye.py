"""Images of a fisheye, and a map that is made of them."""

from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera, pose_distance_mm_deg
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom
from rooms.fisheye import fisheye_image

FOCAL = 160 / np.deg2rad(75)
WIDE = Camera(320, 240, FOCAL, FOCAL, 159.5, 119.5, model="fisheye")


def directions(camera: Camera, pose: SE3) -> np.ndarray:
    """Unit vectors (H, W, 3) of the rays of all pixels."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.unproject(np.stack([u, v], -1)) @ pose.rotation_matrix().T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def test_a_fisheye_shows_what_its_projection_says() -> None:
    """A room whose colour is the direction: each pixel shows its own ray."""

    def render(camera: Camera, pose: SE3) -> np.ndarray:
        return np.round(127.5 + 127.5 * directions(camera, pose)).astype(np.uint8)

    pose = SE3.exp([0.3, 0.1, 0.2, 0.4, -0.8, 0.3])
    image = fisheye_image(WIDE, pose, render)
    difference = image - (127.5 + 127.5 * directions(WIDE, pose))
    v, u = np.mgrid[:240, :320]
    angle = np.hypot(u - 159.5, v - 119.5) / FOCAL
    assert np.abs(difference[angle < np.deg2rad(84)]).max() < 3
    assert (image[angle > np.deg2rad(86)] == 0).all()


@pytest.mark.slow(
    "src/evercal/mapping", "src/evercal/localization", "src/evercal/geometry"
)
def test_a_map_of_a_fisheye_locates_to_a_millimetre(tmp_path: Path) -> None:
    from evercal import Map

    room = BoxRoom(6)
    path = room.path(40, 1)
    tests = room.path(4, 2)
    images = [fisheye_image(WIDE, pose, room.render) for pose in path]
    frames = [Frame(str(i), image, WIDE, path[i]) for i, image in enumerate(images)]
    Map.open(tmp_path / "map").learn(
        Recording("room", tuple(frames), ()), on_progress=lambda *_: None
    )
    again = Map.open(tmp_path / "map")  # from the disk
    for pose in tests:
        found = again.localize(
            fisheye_image(WIDE, pose, room.render), WIDE
        ).base_from_camera
        assert found is not None
        millimetres, degrees = pose_distance_mm_deg(found, pose)
        assert millimetres < 1.0
        assert degrees < 0.05
