"""A localizer on any device answers as on the CPU, and makes no tensor on another."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from evercal.errors import InputError
from evercal.features.vlad import Vlad
from evercal.geometry.se3 import pose_distance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import SceneMaps
from evercal.recordings.frame import Recording

from ..one_device import META, OneDevice, made_where_inputs_lie


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


@pytest.fixture(params=["map", "network"])
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
    with made_where_inputs_lie():
        found = Localizer(moved(maps, torch.device("cpu")))
        assert numbers(found.localize(frame.read_image(), frame.camera)) == expected


def test_a_vlad_is_made_where_the_features_lie(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(0)
    centroids, features = (
        torch.nn.functional.normalize(torch.randn(n, 6, generator=generator), dim=1)
        for n in (5, 200)
    )
    vlad = Vlad(centroids, torch.randn(30, 16, generator=generator))
    found = vlad(features.to(device))
    assert found.device == device
    torch.testing.assert_close(found.cpu(), vlad(features), atol=1e-5, rtol=0)
    # Off the CPU the sums are made as a product, so that their order is always the same.
    with OneDevice():
        assert vlad(features.to(META)).device == META


def test_a_store_opens_on_the_device_that_is_asked_for(
    hall_maps: SceneMaps, tmp_path: Path, make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path / "store", [hall_maps])
    assert Localizer.open(tmp_path / "store", device="cpu").maps.device == torch.device("cpu")
    asked: list[torch.device] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(SceneMaps, "to", lambda maps, where: asked.append(where) or maps)
    Localizer.open(tmp_path / "store")
    Localizer.open(tmp_path / "store", device="cuda")
    Localizer.open(tmp_path / "store", device="cpu")
    assert asked == [torch.device("cuda", 0), torch.device("cuda", 0), torch.device("cpu")]


def test_a_device_that_is_not_there_is_refused_before_the_store_is_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="device 'gpu'"):
        Localizer.open(tmp_path / "none", device="gpu")
