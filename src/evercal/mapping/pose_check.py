"""Finds frames whose stated pose contradicts the images, before anything is built on it.

Two frames that look alike show the same surfaces. A patch of one must then lie in the other on the
segment that its viewing ray spans between the nearest and the farthest depth. Where most patches do
not, one of the two poses is wrong; the one that contradicts most of its partners is named.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from evercal.features.precision import fast_bfloat16
from evercal.features.views import ideal_cell_pixels
from evercal.features.vlad import Vlad
from evercal.mapping.plane_sweep import FAR_M, NEAR_M, USUAL_M
from evercal.mapping.prepared_frames import PreparedFrames

Array = NDArray[np.floating]

CLEAR_PX, BESIDE_PX = 16.0, 4.0
"""Matches tell depths where parallax moves them by more than the first, and they lie nearer to
their lines than the second: pixels at the encoder's working size."""
LEAST_DEPTHS = 100
"""Fewer of them tell nothing."""


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


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two frames that look alike and what matches between them, pixels of the ideal pinhole."""

    first: int
    second: int
    """Numbers of the frames."""
    ray: Array
    """(n, 3) in the first one's camera frame, at depth 1."""
    seen: Array
    """(n, 2) pixels at working size in the second one."""


def matched_pairs(
    recording: PreparedFrames, vlad: Vlad, options: PoseCheckOptions
) -> list[MatchedPair]:
    """Every frame with those that look most alike, where enough of their patches match."""
    count = len(recording)
    whole = torch.stack([vlad(recording.features(i)) for i in range(count)])
    alike = (whole @ whole.T).fill_diagonal_(-1).topk(min(options.partners, count - 1)).indices
    pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(alike.tolist()) for j in row})
    matched = [_matched(recording, i, j, options) for i, j in pairs]
    return [pair for pair in matched if len(pair.ray) >= options.min_matches]


def contradicting_frames(
    recording: PreparedFrames, pairs: list[MatchedPair], options: PoseCheckOptions
) -> NDArray[np.int64]:
    """Frames whose stated pose disagrees with most of the frames that look alike."""
    count = len(recording)
    judged = [(pair.first, pair.second, _distance(recording, pair)) for pair in pairs]
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


def depth_scale(recording: PreparedFrames, pairs: list[MatchedPair]) -> float:
    """How far away surfaces are, in parts of what is usual in a room; 1 where that range fits.

    Recordings have other scales where their unit of length is unknown, and seen from a wrist or in
    a hall. Matches that parallax moves clearly are triangulated.
    """
    depths = [_triangulated(recording, pair) for pair in pairs]
    depth = np.concatenate([np.zeros(0), *depths])
    if len(depth) < LEAST_DEPTHS:
        return 1.0
    near, middle, far = np.quantile(depth, [0.1, 0.5, 0.9])
    usual = near > NEAR_M and far < FAR_M / 2
    return 1.0 if usual else float(middle / USUAL_M)


def _matched(recording: PreparedFrames, i: int, j: int, options: PoseCheckOptions) -> MatchedPair:
    """Patches that are most alike both ways."""
    a, b = recording.features(i)[:: options.stride], recording.features(j)
    if fast_bfloat16(a.device):
        a, b = a.bfloat16(), b.bfloat16()
    similar = a @ b.T
    best = similar.max(1)
    back = similar.argmax(0)
    rows = torch.arange(len(a))
    mutual = (back[best.indices] == rows) & (best.values > options.min_similarity)
    stride = recording.encoder.stride
    camera, other = recording.cell_camera(i), recording.cell_camera(j)
    pixels = ideal_cell_pixels(camera, stride)[(rows[mutual] * options.stride).numpy()]
    plane = (pixels.astype(np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    ray = np.concatenate([plane, np.ones((len(plane), 1))], 1)
    seen = ideal_cell_pixels(other, stride)[best.indices[mutual].numpy()].astype(np.float64)
    known = np.isfinite(ray).all(1) & np.isfinite(seen).all(1)  # the lens has no ray for some cells
    return MatchedPair(i, j, ray[known], seen[known])


def _distance(recording: PreparedFrames, pair: MatchedPair) -> float:
    """Median distance of matches from their segments."""
    other, scale = recording.cell_camera(pair.second), recording.depth_scale
    turn, shift = recording.relative(pair.second, pair.first)
    ends = [
        _pinhole(other, pair.ray @ turn.T + shift / (scale * depth)) for depth in (FAR_M, NEAR_M)
    ]
    return float(np.median(_segment_distance(pair.seen, *ends)))


def _triangulated(recording: PreparedFrames, pair: MatchedPair) -> Array:
    """Depths of the matches that parallax moves far along their lines and that lie near them."""
    other = recording.cell_camera(pair.second)
    turn, shift = recording.relative(pair.second, pair.first)
    seen = (pair.seen - [other.cx, other.cy]) / [other.fx, other.fy]
    far = pair.ray @ turn.T
    # Where (far + shift / depth) is seen: off + along / depth = 0.
    off, along = far[:, :2] - seen * far[:, 2:], shift[:2] - seen * shift[2]
    inverse = -(off * along).sum(1) / np.maximum((along**2).sum(1), 1e-18)
    moved = inverse * np.linalg.norm(along, axis=1) * other.fx
    beside = np.linalg.norm(off + along * inverse[:, None], axis=1) * other.fx
    return 1 / inverse[(moved > CLEAR_PX) & (beside < BESIDE_PX)]


def _pinhole(camera, points: Array) -> Array:
    plane = points[:, :2] / np.maximum(points[:, 2:], 1e-2)
    return plane * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _segment_distance(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    length = np.maximum((along**2).sum(1), 1e-12)
    share = (((points - start) * along).sum(1) / length).clip(0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)
