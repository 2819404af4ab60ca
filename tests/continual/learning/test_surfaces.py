"""Depths of frames and known points of feature rows, against walls in closed form."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from evercal.continual.learning import surfaces
from evercal.continual.learning.surfaces import (
    frame_depths,
    shared_depths,
    surface_points,
)
from evercal.continual.networks.buffer import EncodePlan, FeatureBuffer, encode_frames
from evercal.continual.networks.descriptor import GlobalDescriptor
from evercal.features.encoder import load_encoder
from evercal.features.views import ViewOptions, ideal_cell_pixels
from evercal.geometry import SE3
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom

from ...box_world import box_room_scene
from ...encoders import BlockMean

SIDE = 120
FRAMES = box_room_scene(3, 4, 1).train
ROOM = BoxRoom(3)
PLAN = EncodePlan(views_per_frame=3, cells=60, view=ViewOptions(short_side=SIDE))


def _depths(frames: Sequence[Frame] = FRAMES) -> list[np.ndarray]:
    """True depths of the cells of frames along the optical axis."""
    depths = []
    for frame in frames:
        small = frame.camera.short_side_resized(SIDE)
        rays = small.pinhole.unproject(ideal_cell_pixels(small, 8))
        pose = frame.base_from_camera
        assert pose is not None
        _, along = ROOM.intersect(pose.translation_m, rays @ pose.rotation_matrix().T)
        depths.append(along.reshape(small.height // 8, small.width // 8))
    return depths


def test_agreed_depths_are_those_of_the_walls() -> None:
    frames = box_room_scene(3, 12, 1).train
    depths = np.stack(frame_depths(frames, load_encoder(), SIDE))
    truth = np.stack(_depths(frames))
    known = np.isfinite(depths)
    assert known.mean() > 0.05  # few views of a bare room have parallax
    errors = (np.abs(depths - truth) / truth)[known]
    assert np.median(errors) < 0.03
    assert (errors < 0.1).mean() > 0.9
    # Wrong poses agree on little, and a single frame on nothing.
    poses = [frame.base_from_camera for frame in frames]
    swapped = [
        replace(f, base_from_camera=poses[(5 * i + 3) % 12])
        for i, f in enumerate(frames)
    ]
    wrong = np.stack(frame_depths(swapped, load_encoder(), SIDE))
    assert np.isfinite(wrong).mean() < 0.5 * known.mean()
    assert np.isnan(frame_depths(frames[:1], load_encoder(), SIDE)).all()


@pytest.fixture(scope="module")
def buffer() -> FeatureBuffer:
    atlas_from_base = SE3.exp(np.array([5.0, -2.0, 1.0, 0.0, 0.0, 0.3]))
    buffer = FeatureBuffer(0, atlas_from_base)
    descriptor = GlobalDescriptor(1, maps=2, hidden=4, width=8).eval()
    for _ in encode_frames(buffer, FRAMES, PLAN, BlockMean(), descriptor):
        pass
    return buffer


def test_points_project_to_the_pixels_of_their_rows(buffer: FeatureBuffer) -> None:
    points = surface_points(buffer, FRAMES, _depths(), 8)
    rows = buffer.rows(torch.arange(len(buffer)))
    matrix = rows.target.camera_from_atlas
    in_camera = torch.einsum("nij,nj->ni", matrix[:, :, :3], points) + matrix[:, :, 3]
    focal = rows.target.intrinsics[:, :2]
    centre = rows.target.intrinsics[:, 2:]
    pixels = in_camera[:, :2] / in_camera[:, 2:] * focal + centre
    torch.testing.assert_close(pixels, rows.target.pixels, atol=2e-3, rtol=0)


def test_points_lie_on_the_walls(buffer: FeatureBuffer) -> None:
    """Exactly in plain views, to the slant within a cell in augmented ones."""
    points = surface_points(buffer, FRAMES, _depths(), 8).double().numpy()
    in_base = buffer.atlas_from_base.inverse().apply(points)
    view = buffer.tensors["view"].numpy()
    for number in range(3 * len(FRAMES)):
        pose = FRAMES[number % len(FRAMES)].base_from_camera
        assert pose is not None
        ray = in_base[view == number] - pose.translation_m
        _, along = ROOM.intersect(pose.translation_m, ray)
        error = np.abs(along - 1)
        if number < len(FRAMES):
            assert error.max() < 1e-4
        else:
            assert np.median(error) < 0.05


def test_unknown_depths_give_no_points(buffer: FeatureBuffer) -> None:
    depths = _depths()
    depths[0][:] = np.nan
    unknown = surface_points(buffer, FRAMES, depths, 8).isnan().all(1)
    assert torch.equal(unknown, buffer.tensors["view"] % len(FRAMES) == 0)


def test_depths_are_shared_by_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def estimate(frames: list[Frame], *_: object) -> list[np.ndarray]:
        calls.append(len(frames))
        return [np.full((3, 4), float(i)) for i in range(len(frames))]

    monkeypatch.setattr(surfaces, "frame_depths", estimate)
    encoder = load_encoder()
    first = shared_depths(tmp_path / "cache", FRAMES, encoder, SIDE)
    again = shared_depths(tmp_path / "cache", FRAMES, encoder, SIDE)
    np.testing.assert_array_equal(first, again)
    shared_depths(tmp_path / "cache", FRAMES[1:], encoder, SIDE)
    shared_depths(tmp_path / "cache", FRAMES, encoder, 2 * SIDE)
    shared_depths(None, FRAMES, encoder, SIDE)
    other = [replace(frame, image=255 - frame.read_image()) for frame in FRAMES]
    shared_depths(tmp_path / "cache", other, encoder, SIDE)
    assert calls == [4, 3, 4, 4, 4]
