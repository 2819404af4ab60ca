"""A camera whose distortion polynomial folds inside the image: its corners have no rays."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from evercal.features.encoder import load_encoder
from evercal.features.views import ideal_cell_pixels
from evercal.geometry import Camera, pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.build import MapOptions, build_map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom

CAMERA = Camera(160, 120, 118.0, 118.0, 79.5, 59.5, (-0.4, 0.0, 0.0, 0.0))
"""Its rays end 72 pixels from the middle; its corners are 99 pixels away."""


def distorted(recording: Recording, room: BoxRoom) -> Recording:
    """The recording as `CAMERA` records it, with sensor noise where there are no rays."""
    ideal = Camera(480, 480, 240.0, 240.0, 239.5, 239.5)
    v_u = np.mgrid[0:120, 0:160]
    rays = CAMERA.unproject(np.moveaxis(v_u[::-1], 0, -1).astype(float))
    pixels = np.nan_to_num(ideal.project(rays), nan=-9.0).astype(np.float32)
    dark = np.isnan(rays).any(-1)
    rng = np.random.default_rng(0)
    frames = []
    for frame in (*recording.train[:16], *recording.test[2:14:4]):
        assert frame.base_from_camera is not None
        image = room.render(ideal, frame.base_from_camera)
        image = cv2.remap(image, pixels, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        image[dark] = rng.integers(0, 60, (dark.sum(), 3))
        frames.append(replace(frame, image=image, camera=CAMERA))
    return Recording("distorted", tuple(frames[:16]), tuple(frames[16:]))


def test_scene_is_mapped_and_images_are_located(
    arcs: tuple[Recording, Recording],
) -> None:
    recording = distorted(arcs[0], BoxRoom(34, texture_px=96))
    options = MapOptions(MemoryBudget(share=0.25), WorkingSize(cells=120))
    scene = build_map("distorted", recording.train, load_encoder(), options).scene
    for camera, landmarks in zip(
        scene.keyframes.cameras, scene.keyframes.landmarks, strict=True
    ):
        assert len(landmarks) > 30
        assert np.isfinite(landmarks.surface(camera)[0]).all()
    localizer = Localizer(MapContents(load_encoder(), 120, [scene]))
    for frame in recording.test:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        assert estimate.base_from_camera is not None
        assert frame.base_from_camera is not None
        assert (
            pose_distance(estimate.base_from_camera, frame.base_from_camera)[0] < 0.02
        )


def test_some_cells_have_no_ray() -> None:
    pixels = ideal_cell_pixels(CAMERA, 8)
    valid = np.isfinite(pixels).all(1)
    assert 0.6 < valid.mean() < 0.95
    assert np.isfinite(pixels[valid]).all()
