"""A lens whose polynomial folds inside the image: corners that no ray belongs to do no harm."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from evercal.continual.learn import learn
from evercal.continual.networks.descriptor import load_descriptor
from evercal.continual.stage import Stage, StageOptions
from evercal.continual.strategies import STRATEGIES
from evercal.features.encoder import load_encoder
from evercal.features.views import ViewOptions, plain_view
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_maps import SceneMaps
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom

LENS = Camera(160, 120, 118.0, 118.0, 79.5, 59.5, (-0.4, 0.0, 0.0, 0.0))
"""Its rays end 72 pixels from the middle, its corners lie at 99."""


def _bent(scene: Recording, room: BoxRoom) -> Recording:
    """The scene as the lens sees it; what it has no rays for shows the noise of a dark sensor."""
    ideal, v_u = Camera(480, 480, 240.0, 240.0, 239.5, 239.5), np.mgrid[0:120, 0:160]
    rays = LENS.unproject(np.moveaxis(v_u[::-1], 0, -1).astype(float))
    where = np.nan_to_num(ideal.project(rays), nan=-9.0).astype(np.float32)
    dark = np.isnan(rays).any(-1)
    rng, frames = np.random.default_rng(0), []
    for frame in (*scene.train[:16], *scene.test[2:14:4]):
        assert frame.base_from_camera is not None
        image = room.render(ideal, frame.base_from_camera)
        image = cv2.remap(image, where, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        image[dark] = rng.integers(0, 60, (dark.sum(), 3))
        frames.append(replace(frame, image=image, camera=LENS))
    return Recording("bent", tuple(frames[:16]), tuple(frames[16:]))


def test_a_lens_that_folds_is_learned_and_located(arcs: tuple[Recording, Recording]) -> None:
    scene = _bent(arcs[0], BoxRoom(34, texture_px=96))
    maps = SceneMaps(load_encoder(), load_descriptor(), "evercal", 120)
    *_, stage = learn(maps, STRATEGIES["evercal"], scene, StageOptions(memory_share=0.25))
    assert isinstance(stage, Stage)
    kept = stage.maps.keyframes[0]
    assert kept is not None
    for camera, marks in zip(kept.cameras, kept.landmarks, strict=True):
        assert len(marks) > 30
        assert np.isfinite(marks.surface(camera)[0]).all()
    localizer = Localizer(stage.maps)
    for frame in scene.test:
        found = localizer.localize(frame.read_image(), frame.camera)
        assert found.base_from_camera is not None
        assert frame.base_from_camera is not None
        assert pose_distance(found.base_from_camera, frame.base_from_camera)[0] < 0.02


def test_cells_without_a_ray_are_no_part_of_a_view() -> None:
    view = plain_view(np.zeros((120, 160), np.uint8), LENS, 8, ViewOptions(short_side=120))
    assert 0.6 < view.valid.mean() < 0.95
    assert np.isfinite(view.cell_pixels[view.valid]).all()
