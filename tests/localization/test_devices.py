"""A localizer on a GPU gives the same poses."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from evercal.geometry import pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings.frame import Recording


def on_device(contents: MapContents, device: torch.device) -> MapContents:
    """A copy whose encoder is on a device."""
    copied = replace(contents, encoder=copy.deepcopy(contents.encoder))
    assert copied.to(device) is copied
    assert copied.device == device
    return copied


@pytest.mark.gpu
def test_poses_equal_those_of_the_cpu(
    hall: Recording, hall_map: MapContents, cuda: torch.device
) -> None:
    """Features are rounded differently on another device; poses differ less than they err."""
    frames = hall.test[2:20:4]
    here, there = Localizer(hall_map), Localizer(on_device(hall_map, cuda))
    single = [there.localize(f.read_image(), f.camera) for f in frames]
    batch = there.localize_batch([f.read_image() for f in frames], [f.camera for f in frames])
    for frame, one, other in zip(frames, single, batch, strict=True):
        expected = here.localize(frame.read_image(), frame.camera)
        assert expected.base_from_camera is not None
        for estimate in (one, other):
            assert estimate.status == "ok"
            assert estimate.base_from_camera is not None
            assert pose_distance(estimate.base_from_camera, expected.base_from_camera)[0] < 0.005


@pytest.mark.gpu
def test_map_opens_on_the_given_device(hall_map: MapContents, tmp_path: Path) -> None:
    contents = MapContents(hall_map.encoder, hall_map.short_side)
    MapStore(tmp_path / "map", contents).commit(hall_map.scenes[0], {})
    for name, kind in (("auto", "cuda"), ("cuda", "cuda"), ("cpu", "cpu")):
        assert Localizer.open(tmp_path / "map", device=name).contents.device.type == kind
