"""Depths of all frames of a recording where several agree, and scene points of their rows."""

import hashlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evercal.continual.learning.stage import OnEvent, Part, unobserved
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.feature_cache import cached, encoder_key
from evercal.features.encoder import Encoder
from evercal.mapping.pose_check import depth_scale, matched_pairs
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.recordings.frame import Frame, stated_poses
from evercal.typing import Array

SOURCE_VIEWS = 8
"""Maximum number of source frames of a plane sweep."""
AGREEING = 2
"""Other frames whose depths must agree with that of a cell."""
TOLERANCE = 0.04
"""Relative difference of depths that agree."""
_NEAR_M = 0.05
"""Minimum depth of a point in another frame, metres."""


def frame_depths(
    frames: Sequence[Frame],
    encoder: Encoder,
    short_side: int,
    on_event: OnEvent = unobserved,
) -> list[Array]:
    """Estimate the depth of every cell of every frame by plane sweeps.

    The depth of a cell counts if at least two other frames have the same surface there, as in
    multi-view stereo (Schönberger et al., Pixelwise view selection, ECCV 2016). Depths (rows,
    columns) are along the optical axis in metres; NaN where frames disagree.
    """
    prepared = PreparedFrames(frames, encoder, WorkingSize(short_side, short_side))
    numbers = range(len(prepared))
    pairs = matched_pairs(prepared)
    prepared.depth_scale = depth_scale(prepared, pairs)
    swept = []
    sources = []
    for i in numbers:
        inverse, near = prepared.swept(i, SOURCE_VIEWS)
        swept.append(1 / inverse.astype(float))
        sources.append(near)
        on_event(Part("depths", i + 1, len(prepared)))
    return [_agreed(prepared, i, swept, sources[i]) for i in numbers]


def _agreed(
    prepared: PreparedFrames, i: int, swept: list[Array], near: list[int]
) -> Array:
    """Depths of a frame as a grid; NaN where too few of the other frames agree."""
    view = prepared.posed_cells(i)
    points = view.base_from_camera.apply(view.rays() * swept[i][:, None])
    votes = np.zeros(len(points), int)
    for j in near:
        other = prepared.posed_cells(j)
        in_camera = other.base_from_camera.inverse().apply(points)
        depth = in_camera[:, 2]
        in_camera[depth <= _NEAR_M] = np.nan
        pixels = other.camera.project(in_camera)
        surface = _at_pixels(swept[j].reshape(other.grid), pixels, other.stride)
        votes += np.abs(surface - depth) < TOLERANCE * depth
    depths = np.where(votes >= AGREEING, swept[i], np.nan)
    return depths.reshape(view.grid)


def _at_pixels(depths: Array, pixels: Array, stride: int) -> Array:
    """Depths (n,) of the cells nearest to pixels (n, 2); NaN outside the grid."""
    position = (pixels - (stride - 1) / 2) / stride
    cell = np.nan_to_num(position, nan=-9.0).round().astype(int)
    inside = ((cell >= 0) & (cell < depths.shape[::-1])).all(1)
    column, row = cell[inside].T
    known = np.full(len(pixels), np.nan)
    known[inside] = depths[row, column]
    return known


def shared_depths(
    cache: Path | None,
    frames: Sequence[Frame],
    encoder: Encoder,
    short_side: int,
    on_event: OnEvent = unobserved,
) -> list[Array]:
    """Estimate the depths of frames, see `frame_depths`, or read those of an earlier run.

    `cache` is the folder of the depths of all runs. Without one, or with frames of several sizes,
    they are always estimated.
    """
    sizes = {frame.camera.size for frame in frames}
    if not cache or len(sizes) > 1:
        return frame_depths(frames, encoder, short_side, on_event)
    key = hashlib.blake2b(digest_size=16)
    poses = stated_poses(frames).matrix()
    for frame, pose in zip(frames, poses, strict=True):
        key.update(f"{frame.name} {frame.camera} {short_side}".encode())
        key.update(pose.tobytes() + frame.read_image().tobytes())
    key.update(encoder_key(encoder).encode())

    def estimated() -> Array:
        return np.stack(frame_depths(frames, encoder, short_side, on_event))

    return list(cached(cache / f"depths-{key.hexdigest()}.npy", estimated))


def surface_points(
    buffer: FeatureBuffer,
    frames: Sequence[Frame],
    depths: Sequence[Array],
    stride: int,
) -> Tensor:
    """Compute the points (rows, 3) of a buffer in the atlas from the depths of its frames.

    Frames are in the order in which they were encoded. A row takes the depth of the nearest cell of
    its frame, along its own ray; the point is NaN where the depth is unknown.
    """
    all_pixels = buffer.tensors["pixels"].cpu().double().numpy()
    all_intrinsics = buffer.tensors["intrinsics"].cpu().numpy()
    points = np.full((len(buffer), 3), np.nan)
    for number, (start, end) in enumerate(pairwise(buffer.starts.tolist())):
        frame = frames[number % len(frames)]
        depth = depths[number % len(frames)]
        assert frame.base_from_camera, "training frames are posed"
        focal, centre = all_intrinsics[number].reshape(2, 2)
        plane = (all_pixels[start:end] - centre) / focal
        ray = np.column_stack([plane, np.ones(len(plane))])
        camera = frame.camera.short_side_resized(stride * min(depth.shape))
        known = _at_pixels(depth, camera.project(ray), stride)
        atlas_from_camera = buffer.atlas_from_base @ frame.base_from_camera
        points[start:end] = atlas_from_camera.apply(ray * known[:, None])
    return torch.from_numpy(points).float()
