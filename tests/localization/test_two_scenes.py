"""Images of two scenes in one map."""

from __future__ import annotations

import pytest

from evercal.features.encoder import load_encoder
from evercal.geometry import pose_distance
from evercal.localization.localizer import Localizer
from evercal.localization.options import LocalizeOptions
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording


@pytest.fixture(scope="module")
def two_scenes(arcs: tuple[Recording, Recording]) -> MapContents:
    """A map of both arcs, whose cameras are the same."""
    contents = MapContents(load_encoder(), 120)
    options = MapOptions(MemoryBudget(share=0.5), WorkingSize(cells=120))
    for arc in arcs:
        scene = build_map(arc.name, arc.train[::2], contents.encoder, options).scene
        contents.scenes.append(scene)
    return contents


@pytest.mark.parametrize("candidates", [1, 3])
def test_images_are_located_in_their_own_scene(
    candidates: int, two_scenes: MapContents, arcs: tuple[Recording, Recording]
) -> None:
    localizer = Localizer(two_scenes, LocalizeOptions(candidates=candidates))
    assert localizer.scenes == ("one", "two")
    for arc in arcs:
        for frame in arc.test[2::8]:
            estimate = localizer.localize(frame.read_image())
            assert estimate.scene == arc.name
            assert estimate.base_from_camera is not None
            assert frame.base_from_camera is not None
            metres, _ = pose_distance(estimate.base_from_camera, frame.base_from_camera)
            assert metres < 0.03
