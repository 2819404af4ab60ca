"""Depths of the frames of a box room, whose walls are known."""

import numpy as np

from evercal.continual.learning.surfaces import frame_depths
from evercal.features.encoder import load_encoder
from evercal.features.views import ideal_cell_pixels
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom

from ...box_world import box_room_scene

SIDE = 120


def _truth(room: BoxRoom, frame: Frame) -> np.ndarray:
    """True depth (rows, columns) of the cells along the optical axis."""
    small = frame.camera.short_side_resized(SIDE)
    rays = small.pinhole.unproject(ideal_cell_pixels(small, 8))
    pose = frame.base_from_camera
    assert pose is not None
    _, distance = room.intersect(pose.translation_m, rays @ pose.rotation_matrix().T)
    return distance.reshape(small.height // 8, small.width // 8)


def test_agreed_depths_are_those_of_the_walls() -> None:
    frames = box_room_scene(3, 12, 1).train
    depths = frame_depths(frames, load_encoder(), SIDE)
    room = BoxRoom(3)
    errors, known = [], []
    for frame, depth in zip(frames, depths, strict=True):
        truth = _truth(room, frame)
        assert depth.shape == truth.shape
        known.append(np.isfinite(depth).mean())
        errors.append((np.abs(depth - truth) / truth)[np.isfinite(depth)])
    assert np.mean(known) > 0.05  # few views of a bare room have parallax
    assert np.median(np.concatenate(errors)) < 0.03
    assert (np.concatenate(errors) < 0.1).mean() > 0.9


def test_wrong_poses_agree_on_little() -> None:
    frames = box_room_scene(3, 12, 1).train
    poses = [frame.base_from_camera for frame in frames]
    swapped = [
        Frame(frame.name, frame.image, frame.camera, poses[(5 * i + 3) % 12])
        for i, frame in enumerate(frames)
    ]
    right, wrong = (frame_depths(some, load_encoder(), SIDE) for some in (frames, swapped))
    assert np.isfinite(np.stack(wrong)).mean() < 0.5 * np.isfinite(np.stack(right)).mean()


def test_a_single_frame_has_no_depth() -> None:
    (depth,) = frame_depths(box_room_scene(3, 3, 1).train[:1], load_encoder(), SIDE)
    assert np.isnan(depth).all()
