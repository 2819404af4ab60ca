"""A localizer on any device answers as on the CPU, and makes no tensor on another."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps

from evercal.geometry.se3 import pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.recordings.frame import Recording

from ...one_device import tensors_stay_on_their_device


def moved(maps: SceneMaps, device: torch.device) -> SceneMaps:
    """A copy whose networks lie on a device; what others use stays where it is."""
    networks = copy.deepcopy((maps.encoder, maps.descriptor, maps.heads))
    encoder, descriptor, heads = networks
    twin = replace(maps, encoder=encoder, descriptor=descriptor, heads=heads)
    assert twin.to(device) is twin
    assert twin.device == device
    return twin


def numbers(found: PoseEstimate) -> list[object]:
    """All of an answer but the time it took."""
    arrays = [found.covariance, found.pixels, found.points_m]
    pose = found.base_from_camera
    arrays.append(None if pose is None else pose.matrix())
    plain = [found.status, found.reason, found.scene, found.inliers, found.inlier_ratio]
    return [*plain, *(None if array is None else array.tobytes() for array in arrays)]


@pytest.fixture(params=["network"])
def known(request: pytest.FixtureRequest) -> tuple[SceneMaps, Recording]:
    """A map, and networks of two scenes, with a scene that they know."""
    if request.param == "map":
        return request.getfixturevalue("hall_maps"), request.getfixturevalue("hall")
    return request.getfixturevalue("arc_maps")[1], request.getfixturevalue("arcs")[0]


def test_poses_are_those_of_the_cpu(
    known: tuple[SceneMaps, Recording], device: torch.device
) -> None:
    """Features are rounded otherwise on another device, so poses differ by less than they err."""
    maps, scene = known
    frames = scene.test[2:20:4]
    here, there = Localizer(maps), Localizer(moved(maps, device))
    alone = [there.localize(f.read_image(), f.camera) for f in frames]
    batch = there.localize_batch([f.read_image() for f in frames], [f.camera for f in frames])
    tolerance = 0.005 if maps.heads == [] else 0.05
    for frame, one, same in zip(frames, alone, batch, strict=True):
        expected = here.localize(frame.read_image(), frame.camera)
        assert one.status == same.status == expected.status == "ok"
        assert expected.base_from_camera is not None
        for found in (one, same):
            assert found.base_from_camera is not None
            metres, _ = pose_distance(found.base_from_camera, expected.base_from_camera)
            assert metres < tolerance


def test_nothing_is_made_on_the_default_device(known: tuple[SceneMaps, Recording]) -> None:
    maps, scene = known
    frame = scene.test[7]
    expected = numbers(Localizer(maps).localize(frame.read_image(), frame.camera))
    with tensors_stay_on_their_device():
        found = Localizer(moved(maps, torch.device("cpu")))
        assert numbers(found.localize(frame.read_image(), frame.camera)) == expected
