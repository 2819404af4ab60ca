"""Remembered frames of a box room answer for a view beside them; the room's surfaces are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from evercal.datasets.frame import Frame
from evercal.features.descriptor import load_descriptor
from evercal.features.encode import encode
from evercal.features.encoder import load_encoder
from evercal.features.views import ViewOptions, frame_view, ideal_cell_pixels
from evercal.geometry.se3 import SE3
from evercal.localization.keyframe_matcher import MAX_KEYFRAMES, KeyframeMatcher, PosePrior
from evercal.mapping.atlas import Cell
from evercal.mapping.keyframes import Keyframes, store_keyframes
from evercal.mapping.scene_maps import SceneMaps, SceneRecord
from evercal.simulation.box_room import BoxRoom, default_camera

CAMERA = default_camera(320, 240)
CELL = Cell((7.0, -3.0, 2.0), 10.0, (0.5, 0.25, 1.0))


@pytest.fixture(scope="module")
def room() -> BoxRoom:
    return BoxRoom(31, texture_px=256)


def surface(room: BoxRoom, pose: SE3) -> np.ndarray:
    """(cells, 3) what a view's cells show, base frame."""
    pixels = ideal_cell_pixels(CAMERA, 8).astype(float)
    rays = CAMERA.unproject(pixels) @ pose.rotation_matrix().T
    return room.intersect(pose.translation_m, rays)[0]


def frame(room: BoxRoom, pose: SE3, name: str = "query") -> Frame:
    return Frame(name, room.render(CAMERA, pose), CAMERA, pose)


@pytest.fixture(scope="module")
def maps(room: BoxRoom) -> SceneMaps:
    """Every sixth frame of a walk, with true depths."""
    walk = room.path(72, 3)
    poses = [walk[i] for i in range(0, 72, 6)]
    keyframes = store_keyframes([frame(room, pose, str(i)) for i, pose in enumerate(poses)], 240)
    depths = [
        torch.from_numpy(1 / pose.inverse().apply(surface(room, pose))[:, 2]).half()
        for pose in poses
    ]
    keyframes = replace(keyframes, inverse_depth=tuple(depths))
    record = SceneRecord("box", CAMERA, CELL, torch.zeros(1, 128).half(), 72)
    encoder, descriptor = load_encoder(), load_descriptor()
    return SceneMaps(encoder, descriptor, "evercal", 240, [], [record], [keyframes], [{}])


def seen(maps: SceneMaps, query: Frame) -> torch.Tensor:
    features, _ = encode([frame_view(query, 8, ViewOptions())], maps.encoder, maps.descriptor)
    return features[0].flatten(1).T


def errors_px(points: torch.Tensor, pose: SE3) -> np.ndarray:
    """How far from their cells points in the atlas project at the true pose."""
    inside = (CELL.atlas_from_base @ pose).inverse().apply(points.double().numpy())
    inside[inside[:, 2] < 0.05] = [0, 0, 0.05]
    return np.linalg.norm(CAMERA.project(inside) - ideal_cell_pixels(CAMERA, 8), axis=1)


def test_points_lie_where_the_query_sees_them(room: BoxRoom, maps: SceneMaps) -> None:
    matcher = KeyframeMatcher(maps, 0)
    pose = room.path(72, 3)[21]  # half-way between two remembered frames
    features = seen(maps, frame(room, pose))
    found = matcher.match(features, matcher.retrieve(features))
    nowhere = torch.full((1200, 3), 1e3)
    alone = errors_px(matcher.lift(found, nowhere), pose)
    assert np.mean(alone < 5) > 0.4
    atlas_from_camera = CELL.atlas_from_base @ pose
    expected = PosePrior(CAMERA, atlas_from_camera)
    guided = errors_px(matcher.lift(found, nowhere, expected), pose)
    assert np.mean(guided < 5) > np.mean(alone < 5) + 0.02
    # Whole cells would be 3 pixels off in the median.
    assert np.median(guided[guided < 10]) < 2.2
    wrong = SE3.exp(np.array([0.0, 0, 0, 0, 0.5, 0]))
    misled = PosePrior(CAMERA, atlas_from_camera @ wrong)
    assert np.mean(errors_px(matcher.lift(found, nowhere, misled), pose) < 5) < 0.05


def test_only_frames_that_show_the_same_are_looked_at(maps: SceneMaps) -> None:
    keyframes = maps.keyframes[0]
    assert keyframes is not None
    assert len(keyframes.images) > MAX_KEYFRAMES
    matcher, features = KeyframeMatcher(maps, 0), seen(maps, keyframes.frames()[5])
    votes = matcher.retrieve(features)
    assert np.bincount(votes.frame).argmax() == 5
    found = matcher.match(features, votes)
    assert len(found.among) == MAX_KEYFRAMES * 1200
    assert set(range(5 * 1200, 6 * 1200)) <= set(found.among.tolist())
    assert float(found.value.float().max(1).values.median()) > 0.99


def test_depths_come_back_from_a_file_and_count(maps: SceneMaps) -> None:
    keyframes = maps.keyframes[0]
    assert keyframes is not None
    tensors = keyframes.to_tensors()
    assert keyframes.bytes == sum(tensor.nbytes for tensor in tensors.values())
    plain = replace(keyframes, inverse_depth=())
    assert keyframes.bytes == plain.bytes + len(keyframes.images) * (2 * 1200 + 8)
    back = Keyframes.from_tensors(load(save(tensors)))
    assert len(back.inverse_depth) == len(keyframes.images)
    for a, b in zip(back.inverse_depth, keyframes.inverse_depth, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert Keyframes.from_tensors(load(save(plain.to_tensors()))).inverse_depth == ()
