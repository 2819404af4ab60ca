"""Depths of all frames of a recording, kept where several frames agree."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from evercal.features.encoder import Encoder
from evercal.features.vlad import vlad_for
from evercal.mapping.pose_check import depth_scale, matched_pairs
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.recordings.frame import Frame

SOURCE_VIEWS = 8
"""Frames that a depth is swept over, at most."""
AGREEING = 2
"""Other frames whose depths must agree with that of a cell."""
TOLERANCE = 0.04
"""Relative difference of depths that agree."""

Array = NDArray[np.float64]


def frame_depths(
    frames: Sequence[Frame],
    encoder: Encoder,
    short_side: int,
    on_progress: Callable[[int, int], object] = lambda *_: None,
) -> list[Array]:
    """Estimate the depth of every cell of every frame by plane sweeps.

    The depth of a cell counts if at least two other frames have the same surface there, as in
    multi-view stereo (Schönberger et al., Pixelwise view selection, ECCV 2016).

    Args:
        frames: Posed frames.
        encoder: Encoder of the cells.
        short_side: Working size of the images, pixels.
        on_progress: Called with the number of swept frames, and of all frames.

    Returns:
        For each frame, (rows, columns) depths along the optical axis in metres; NaN where frames
        disagree.
    """
    prepared = PreparedFrames(frames, encoder, WorkingSize(short_side, short_side))
    features = [prepared.features(i) for i in range(len(prepared))]
    pairs = matched_pairs(prepared, vlad_for(encoder, features))
    prepared.depth_scale = depth_scale(prepared, pairs)
    swept, sources = [], []
    for i in range(len(prepared)):
        inverse, near = prepared.swept(i, SOURCE_VIEWS)
        swept.append(1 / inverse.double().numpy())
        sources.append(near)
        on_progress(i + 1, len(prepared))
    return [_agreed(prepared, i, swept, sources[i]) for i in range(len(prepared))]


def _agreed(prepared: PreparedFrames, i: int, swept: list[Array], near: list[int]) -> Array:
    """Depths of a frame as a grid; NaN where too few of the other frames agree."""
    view = prepared.posed_cells(i)
    points = view.base_from_camera.apply(view.rays() * swept[i][:, None])
    votes = np.zeros(len(points), int)
    for j in near:
        other = prepared.posed_cells(j)
        within = other.base_from_camera.inverse().apply(points)
        pixels = other.camera.project(np.where(within[:, 2:] > 0.05, within, [0, 0, 1]))
        rows, columns = other.grid
        cell = np.nan_to_num((pixels - (other.stride - 1) / 2) / other.stride, nan=-9.0).round()
        column, row = cell.astype(int).T
        inside = (within[:, 2] > 0.05) & (cell >= 0).all(1) & (column < columns) & (row < rows)
        seen = np.full(len(points), np.nan)
        seen[inside] = swept[j][row[inside] * columns + column[inside]]
        votes += np.abs(seen - within[:, 2]) < TOLERANCE * within[:, 2]
    return np.where(votes >= AGREEING, swept[i], np.nan).reshape(view.grid)
