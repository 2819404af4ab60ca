"""Finds frames whose stated pose contradicts the images, before anything is built on it.

Two frames that look alike show the same surfaces. A patch of one must then lie in the other on the
segment that its viewing ray spans between the nearest and the farthest depth. Where most patches do
not, one of the two poses is wrong; the one that contradicts most of its partners is named.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evercal.features.views import ideal_cell_pixels
from evercal.features.vlad import Vlad
from evercal.mapping.plane_sweep import FAR_M, NEAR_M
from evercal.mapping.recording import Recording

Array = NDArray[np.floating]


@dataclass(frozen=True)
class PoseCheckOptions:
    """What makes a stated pose wrong."""

    partners: int = 5
    """Every frame is compared with this many frames that look most alike."""
    max_distance_px: float = 6.0
    """Median distance of matched patches from their segments in a pair that agrees, pixels at the
    encoder's working size."""
    min_similarity: float = 0.6
    """Smallest cosine of matched features."""
    min_matches: int = 30
    """Pairs with fewer mutual matches say nothing."""
    stride: int = 3
    """Every so many-th patch is matched."""


def contradicting_frames(
    recording: Recording, vlad: Vlad, options: PoseCheckOptions
) -> NDArray[np.int64]:
    """Frames whose stated pose disagrees with most of the frames that look alike."""
    count = len(recording)
    whole = torch.stack([vlad(recording.features(i)) for i in range(count)])
    alike = (whole @ whole.T).fill_diagonal_(-1).topk(min(options.partners, count - 1)).indices
    pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(alike.tolist()) for j in row})
    judged = [(i, j, d) for i, j in pairs if (d := _distance(recording, i, j, options)) is not None]
    bad: list[int] = []
    while judged:
        against, total = np.zeros(count), np.zeros(count)
        for i, j, distance in judged:
            for frame in (i, j):
                total[frame] += 1
                against[frame] += distance > options.max_distance_px
        share = np.where(total >= 2, against / np.maximum(total, 1), 0)
        worst = int(np.lexsort((against, share))[-1])
        if share[worst] <= 0.5:
            break
        bad.append(worst)
        judged = [pair for pair in judged if worst not in pair[:2]]
    return np.array(sorted(bad), np.int64)


def _distance(recording: Recording, i: int, j: int, options: PoseCheckOptions) -> float | None:
    """Median distance of matches from their segments; None where too little matches."""
    a, b = recording.features(i)[:: options.stride], recording.features(j)
    similar = a.bfloat16() @ b.bfloat16().T
    best = similar.max(1)
    back = similar.argmax(0)
    rows = torch.arange(len(a))
    mutual = (back[best.indices] == rows) & (best.values > options.min_similarity)
    if int(mutual.sum()) < options.min_matches:
        return None
    cells_a = (rows[mutual] * options.stride).numpy()
    cells_b = best.indices[mutual].numpy()
    stride = recording.encoder.stride
    camera, other = recording.cell_camera(i), recording.cell_camera(j)
    pixels = ideal_cell_pixels(camera, stride)[cells_a].astype(np.float64)
    plane = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    ray = np.concatenate([plane, np.ones((len(plane), 1))], 1)
    turn, shift = recording.relative(j, i)
    ends = [_pinhole(other, ray @ turn.T + shift / depth) for depth in (FAR_M, NEAR_M)]
    seen = ideal_cell_pixels(other, stride)[cells_b].astype(np.float64)
    distance = _segment_distance(seen, *ends)
    known = distance[np.isfinite(distance)]  # the lens has no ray for some cells
    return float(np.median(known)) if len(known) >= options.min_matches else None


def _pinhole(camera, points: Array) -> Array:
    plane = points[:, :2] / np.maximum(points[:, 2:], 1e-2)
    return plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _segment_distance(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    length = np.maximum((along**2).sum(1), 1e-12)
    share = (((points - start) * along).sum(1) / length).clip(0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)
