"""The feature buffer: projections of its rows, and draws."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from evercal.continual.networks import buffer as module
from evercal.continual.networks.buffer import (
    EncodePlan,
    FeatureBuffer,
    encode_frames,
    join,
)
from evercal.continual.networks.descriptor import GlobalDescriptor, described
from evercal.features.encoder import Encoder
from evercal.features.views import ViewOptions, augmented_view, cell_centres, frame_view
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame
from evercal.simulation.box_room import BoxRoom

from ..draws import seeded

LANDSCAPE = Camera(160, 120, 131.0, 128.0, 83.0, 57.0)
CAMERAS = (
    LANDSCAPE,
    replace(LANDSCAPE, distortion=(-0.22, 0.07, 0.004, -0.003)),
    Camera(120, 160, 128.0, 131.0, 57.0, 83.0),
)
# The buffer must support any pose of the base frame, not only a translation.
ATLAS_FROM_BASE = SE3.exp([10.0, -5.0, 0.3, 0.2, -0.4, 1.1])
PLAN = EncodePlan(
    views_per_frame=3, cells=40, seed=5, view=ViewOptions(short_side=120, gamma=0.0)
)

Filled = Callable[..., FeatureBuffer]


@pytest.fixture(scope="session")
def frames(box: BoxRoom, shoot) -> list[Frame]:
    rng = np.random.default_rng(2)
    return [
        shoot(CAMERAS[i % 3 if i < 3 else 0], box.random_view(rng)) for i in range(7)
    ]


@pytest.fixture
def filled(
    frames: list[Frame],
    block_mean: Encoder,
    describe: GlobalDescriptor,
    device: torch.device,
) -> Filled:
    """Images are encoded on the CPU; rows are drawn on the device of the test."""

    def make(plan: EncodePlan = PLAN, some: Sequence[Frame] = frames) -> FeatureBuffer:
        buffer = FeatureBuffer(4, ATLAS_FROM_BASE, device=device)
        for _ in encode_frames(buffer, some, plan, block_mean, describe):
            pass
        return buffer

    return make


def camera_of(target: module.Target, row: int) -> tuple[Camera, SE3]:
    """Return the ideal camera of a row and `atlas_from_camera`."""
    fx, fy, cx, cy = (float(value) for value in target.intrinsics[row])
    matrix = np.vstack(
        [target.camera_from_atlas[row].cpu().double().numpy(), [0, 0, 0, 1]]
    )
    return Camera(400, 400, fx, fy, cx, cy), SE3.from_matrix(matrix).inverse()


def test_point_of_a_cell_projects_to_its_pixel(
    box: BoxRoom, frames: list[Frame], filled: Filled
) -> None:
    """Cell -> ray of the frame's camera -> point of the room -> atlas -> target of the row."""
    buffer = filled()
    start = 0
    checked = 0
    for number in range(PLAN.views_per_frame):
        for position, frame in enumerate(frames):
            rng = np.random.default_rng([PLAN.seed, number, position])
            small = frame.camera.short_side_resized(120)
            if number == 0:
                view = frame_view(frame, 8, PLAN.view)
                selected = np.arange(len(view.valid))
                rays = small.unproject(cell_centres(small.height, small.width, 8))
            else:
                view = augmented_view(frame, 8, PLAN.view, rng)
                selected = np.sort(
                    rng.permutation(np.flatnonzero(view.valid))[: PLAN.cells]
                )
                rays = replace(small, distortion=()).unproject(view.cell_pixels)[
                    selected
                ]
            pose = frame.base_from_camera
            assert pose is not None
            points, _ = box.intersect(
                pose.translation_m, rays @ pose.rotation_matrix().T
            )
            atlas = ATLAS_FROM_BASE.apply(points)
            rows = buffer.rows(torch.arange(start, start + len(selected)))
            start += len(selected)
            assert (rows.scene == 4).all()
            ideal, atlas_from_camera = camera_of(rows.target, 0)
            captured = ideal.project(atlas_from_camera.inverse().apply(atlas))
            np.testing.assert_allclose(
                rows.target.pixels.cpu().numpy(), captured, atol=1e-2
            )
            checked += len(selected)
    assert start == checked == len(buffer)
    assert buffer.views == PLAN.views_per_frame * len(frames)


def test_feature_belongs_to_the_cell_of_its_target(
    box: BoxRoom, frames: list[Frame], filled: Filled
) -> None:
    """A rendering by the row's camera shows the cell's grey value at the row's pixel."""
    buffer = filled(replace(PLAN, view=replace(PLAN.view, zoom=1.1)))
    actual = []
    expected = []
    views = buffer.tensors["view"]
    for view in range(buffer.views):
        rows = buffer.rows(torch.nonzero(views == view)[:, 0])
        ideal, atlas_from_camera = camera_of(rows.target, 0)
        # Barrel distortion has a wider view.
        ideal = replace(ideal, cx=ideal.cx + 60, cy=ideal.cy + 60)
        image = box.render(ideal, ATLAS_FROM_BASE.inverse() @ atlas_from_camera)
        grey = cv2.blur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (9, 9))
        where = (rows.target.pixels.cpu().numpy() + 60)[:, None].astype(np.float32)
        expected.append(cv2.remap(grey, where, None, cv2.INTER_LINEAR).ravel() / 255)  # type: ignore[call-overload]
        actual.append(rows.features[:, 0].cpu().float().numpy())
        assert np.corrcoef(actual[-1], expected[-1])[0, 1] > 0.9
    difference = np.abs(np.concatenate(actual) - np.concatenate(expected))
    assert np.median(difference) < 0.015


def test_rows_have_the_descriptor_of_their_image(
    frames: list[Frame], filled: Filled, block_mean: Encoder, describe: GlobalDescriptor
) -> None:
    buffer = filled(replace(PLAN, views_per_frame=1))
    rows = buffer.rows(torch.arange(len(buffer)))
    for position, frame in enumerate(frames):
        view = frame_view(frame, 8, PLAN.view)
        _, expected = described(block_mean(view.grey), describe)
        own = rows.descriptor[buffer.tensors["view"] == position]
        assert len(own) == len(view.valid)
        torch.testing.assert_close(
            own.cpu(), expected.expand_as(own), atol=2e-3, rtol=0
        )


def same(a: FeatureBuffer, b: FeatureBuffer) -> bool:
    return a.tensors.keys() == b.tensors.keys() and all(
        torch.equal(value, b.tensors[name]) for name, value in a.tensors.items()
    )


def test_rows_depend_on_the_seed_only(filled: Filled) -> None:
    first = filled()
    np.random.default_rng(0).random(100)
    torch.rand(7)
    assert same(first, filled())
    other = filled(replace(PLAN, seed=6))
    plain = sum(len(frame_cells) for frame_cells in plain_views(first))
    assert torch.equal(first.tensors["pixels"][:plain], other.tensors["pixels"][:plain])
    assert not torch.equal(first.tensors["pixels"], other.tensors["pixels"])


def plain_views(buffer: FeatureBuffer) -> list[Tensor]:
    """Return the row numbers of each view of the first pass."""
    return [torch.nonzero(buffer.tensors["view"] == view)[:, 0] for view in range(7)]


def test_augmented_views_have_the_planned_number_of_valid_cells(
    frames: list[Frame], filled: Filled
) -> None:
    plan = replace(PLAN, cells=25)
    views = filled(plan).tensors["view"]
    counts = torch.bincount(views.long())
    assert counts[:7].tolist() == [(120 // 8) * (160 // 8)] * 7
    assert (counts[7:] == 25).all()
    for number, position in ((1, 0), (2, 3)):
        rng = np.random.default_rng([plan.seed, number, position])
        valid = augmented_view(frames[position], 8, plan.view, rng).valid
        # A larger plan selects all valid cells.
        buffer = filled(replace(plan, cells=10_000))
        count = int((buffer.tensors["view"] == number * 7 + position).sum())
        assert count == valid.sum() <= len(valid)


def test_draws_are_reproducible_and_cover_the_buffer(filled: Filled) -> None:
    buffer = filled(replace(PLAN, views_per_frame=1))
    generator = seeded(3)
    first = buffer.draw(20_000, generator)
    again = buffer.draw(20_000, seeded(3))
    assert torch.equal(first.target.pixels, again.target.pixels)
    _, counts = torch.unique(first.target.pixels, dim=0, return_counts=True)
    every = torch.unique(buffer.tensors["pixels"], dim=0)
    assert len(counts) > 0.99 * len(every)
    assert not torch.equal(
        buffer.draw(50, generator).target.pixels, first.target.pixels[:50]
    )


def test_part_and_join_are_inverse(filled: Filled) -> None:
    buffer = filled(replace(PLAN, views_per_frame=1))
    rows = buffer.draw(30, seeded(1))
    again = join(
        [rows.part(slice(0, 7)), rows.part(slice(7, 8)), rows.part(slice(8, None))]
    )
    for name in ("features", "scene", "descriptor"):
        assert torch.equal(getattr(again, name), getattr(rows, name))
    for name in ("pixels", "intrinsics", "camera_from_atlas"):
        assert torch.equal(getattr(again.target, name), getattr(rows.target, name))


def test_a_training_within_its_limit_is_what_it_was(
    frames: list[Frame], filled: Filled
) -> None:
    whole = filled()
    assert PLAN.rows(frames, 8) >= len(whole)
    limited = replace(PLAN, most_rows=PLAN.rows(frames, 8))
    assert limited.limited(frames, 8) is limited
    assert same(filled(limited), whole)


@pytest.mark.parametrize(
    ("each", "views", "cells"), [(130, 3, 43), (119, 2, 59), (79, 1, 79), (7, 1, 7)]
)
def test_a_limit_takes_rows_of_views_then_views_then_cells(
    each: int, views: int, cells: int, frames: list[Frame], filled: Filled
) -> None:
    plan = replace(PLAN, most_rows=each * len(frames)).limited(frames, 8)
    assert (plan.views_per_frame, plan.cells) == (views, cells)
    buffer = filled(plan)
    assert len(buffer) <= plan.rows(frames, 8) <= each * len(frames)
    counts = torch.bincount(buffer.tensors["view"].long())
    assert counts.tolist() == [cells] * (views * len(frames))
    # The limit of a training holds for its parts.
    assert plan.limited(frames[:3], 8) == plan
    # A thinned plain view has other cells for another seed.
    other = filled(replace(plan, seed=6))
    assert not torch.equal(buffer.tensors["pixels"], other.tensors["pixels"])


def test_every_frame_keeps_a_row(frames: list[Frame], filled: Filled) -> None:
    plan = replace(PLAN, most_rows=3).limited(frames, 8)
    assert torch.equal(filled(plan).tensors["view"], torch.arange(7, dtype=torch.int32))


def test_rows_take_the_memory_of_one_copy(filled: Filled) -> None:
    """Features are written where they stay, even if more come than were planned."""
    buffer = filled()
    features = buffer.tensors["features"]
    first = {name: value[:50] for name, value in buffer.tensors.items()}
    grown = FeatureBuffer(4, ATLAS_FROM_BASE)
    for _ in range(9):
        grown.extend(first)
    assert torch.equal(grown.tensors["features"], features[:50].cpu().repeat(9, 1))
    planned = FeatureBuffer(4, ATLAS_FROM_BASE)
    planned.planned = 100
    planned.extend(first)
    planned.extend(first)
    assert torch.equal(planned.tensors["features"], features[:50].cpu().repeat(2, 1))
    place = planned.tensors["features"].untyped_storage()
    assert place.nbytes() == planned.tensors["features"].nbytes
