"""Depths of all frames of a recording where several agree, and scene points of their rows."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.feature_cache import (
    encoder_key,
    read_cached,
    write_cached,
)
from evercal.features.encoder import Encoder
from evercal.geometry import SE3
from evercal.mapping.pose_check import depth_scale, matched_pairs
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.recordings.frame import Frame, stated_poses
from evercal.typing import Array

SOURCE_VIEWS = 8
"""Frames that a depth is swept over, at most."""
AGREEING = 2
"""Other frames whose depths must agree with that of a cell."""
TOLERANCE = 0.04
"""Relative difference of depths that agree."""


def frame_depths(
    frames: Sequence[Frame], encoder: Encoder, short_side: int
) -> list[Array]:
    """Estimate the depth of every cell of every frame by plane sweeps.

    The depth of a cell counts if at least two other frames have the same surface there, as in
    multi-view stereo (Schönberger et al., Pixelwise view selection, ECCV 2016). Depths (rows,
    columns) are along the optical axis in metres; NaN where frames disagree.
    """
    prepared = PreparedFrames(frames, encoder, WorkingSize(short_side, short_side))
    features = [prepared.features(i) for i in range(len(prepared))]
    pairs = matched_pairs(prepared, encoder.vlad(features))
    prepared.depth_scale = depth_scale(prepared, pairs)
    swept = []
    sources = []
    for i in range(len(prepared)):
        inverse, near = prepared.swept(i, SOURCE_VIEWS)
        swept.append(1 / inverse.astype(np.float64))
        sources.append(near)
    return [_agreed(prepared, i, swept, sources[i]) for i in range(len(prepared))]


def _agreed(
    prepared: PreparedFrames, i: int, swept: list[Array], near: list[int]
) -> Array:
    """Depths of a frame as a grid; NaN where too few of the other frames agree."""
    view = prepared.posed_cells(i)
    points = view.base_from_camera.apply(view.rays() * swept[i][:, None])
    votes = np.zeros(len(points), int)
    for j in near:
        other = prepared.posed_cells(j)
        within = other.base_from_camera.inverse().apply(points)
        pixels = other.camera.project(np.where(within[:, 2:] > 0.05, within, np.nan))
        seen = _at_pixels(swept[j].reshape(other.grid), pixels, other.stride)
        votes += np.abs(seen - within[:, 2]) < TOLERANCE * within[:, 2]
    return np.where(votes >= AGREEING, swept[i], np.nan).reshape(view.grid)


def _at_pixels(depths: Array, pixels: Array, stride: int) -> Array:
    """Depths (n,) of the cells nearest to pixels (n, 2); NaN outside the grid."""
    cell = (
        np.nan_to_num((pixels - (stride - 1) / 2) / stride, nan=-9.0)
        .round()
        .astype(int)
    )
    inside = ((cell >= 0) & (cell < depths.shape[::-1])).all(1)
    column, row = cell[inside].T
    known = np.full(len(pixels), np.nan)
    known[inside] = depths[row, column]
    return known


def shared_depths(
    cache: Path | None, frames: Sequence[Frame], encoder: Encoder, short_side: int
) -> list[Array]:
    """Estimate the depths of frames, see `frame_depths`, or read those of an earlier run.

    `cache` is the folder of the depths of all runs; without one they are always estimated.
    """
    if cache is None:
        return frame_depths(frames, encoder, short_side)
    key = hashlib.blake2b(digest_size=16)
    for frame, pose in zip(frames, stated_poses(frames).matrix(), strict=True):
        key.update(
            f"{frame.name} {frame.camera} {short_side}".encode() + pose.tobytes()
        )
    key.update(encoder_key(encoder).encode())
    path = cache / f"depths-{key.hexdigest()}.npy"
    if (cached := read_cached(path)) is not None:
        return list(cached)
    depths = frame_depths(frames, encoder, short_side)
    if len({depth.shape for depth in depths}) == 1:
        cache.mkdir(parents=True, exist_ok=True)
        write_cached(path, np.stack(depths))
    return depths


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
    tensors = {name: value.cpu() for name, value in buffer.tensors.items()}
    starts = buffer.starts.tolist()
    points = np.full((len(buffer), 3), np.nan)
    for number, four in enumerate(tensors["intrinsics"].numpy()):
        frame = frames[number % len(frames)]
        depth = depths[number % len(frames)]
        assert frame.base_from_camera is not None, "training frames are posed"
        where = slice(*starts[number : number + 2])
        pixels = tensors["pixels"][where].double().numpy()
        ray = np.concatenate(
            [(pixels - four[2:]) / four[:2], np.ones((len(pixels), 1))], 1
        )
        camera = frame.camera.short_side_resized(stride * min(depth.shape))
        known = _at_pixels(depth, camera.project(ray), stride)
        pose: SE3 = buffer.atlas_from_base @ frame.base_from_camera
        points[where] = pose.apply(ray * known[:, None])
    return torch.from_numpy(points).float()
