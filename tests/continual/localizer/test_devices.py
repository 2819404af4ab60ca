"""Networks on a GPU locate as on the CPU."""

from __future__ import annotations

import copy

import pytest
import torch

from evercal.continual.localizer import NetworkLocalizer
from evercal.continual.scenes import LearnedScenes
from evercal.geometry import pose_distance
from evercal.recordings.frame import Recording

Arcs = tuple[Recording, Recording]


@pytest.mark.gpu
def test_poses_are_those_of_the_cpu(
    arc_scenes: tuple[LearnedScenes, LearnedScenes], arcs: Arcs, cuda: torch.device
) -> None:
    """Features are rounded differently, so poses differ by less than their errors."""
    frames = arcs[0].test[2:20:4]
    cpu = NetworkLocalizer(arc_scenes[1])
    moved = copy.deepcopy(arc_scenes[1]).to(cuda)
    assert moved.device == cuda
    other = NetworkLocalizer(moved)
    for frame in frames:
        image = frame.read_image()
        expected, estimate = (one.localize(image, frame.camera) for one in (cpu, other))
        assert estimate.status == expected.status == "ok"
        assert expected.base_from_camera is not None
        assert estimate.base_from_camera is not None
        metres, _ = pose_distance(estimate.base_from_camera, expected.base_from_camera)
        assert metres < 0.05
