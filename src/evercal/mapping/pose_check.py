"""Detect frames whose stated pose contradicts the images.

Similar frames show the same surfaces. A cell of one then matches a cell of the other that lies on
the segment of its viewing ray between the nearest and the farthest depth. If most matches do not,
one of the two poses is wrong: the one that contradicts most of its partners.

The encoder mistakes one square of a chessboard for another, so this is only a suspicion. SIFT and
an essential matrix decide: they confirm the pose, contradict it, or cannot track the frame.
"""

from collections.abc import Collection, Sequence
from functools import lru_cache

import numpy as np
from scipy.spatial.distance import cdist

from evercal.classes import frozen_arrays
from evercal.features.sift import SiftFeatures, epipolar_rays, sift_features
from evercal.features.views import cell_centres, ideal_cell_pixels
from evercal.features.vlad import similar_pairs
from evercal.geometry import Camera, norms
from evercal.mapping.plane_sweep import FAR_M, NEAR_M, USUAL_M
from evercal.mapping.prepared_frames import PreparedFrames
from evercal.typing import Array, BoolArray, IntArray

MIN_PARALLAX_PX = 16.0
"""Smallest parallax of matches that are triangulated, pixels at the encoder's working size."""
MAX_EPIPOLAR_PX = 4.0
"""Largest distance of triangulated matches from their epipolar lines, pixels at the same size."""
MIN_DEPTHS = 100
"""Triangulated matches that a depth scale needs."""
PARTNERS = 5
"""Most similar frames that each frame is compared with."""
MAX_DISTANCE_PX = 6.0
"""Largest median distance of matches from their segments in a consistent pair, pixels
at the encoder's working size."""
MAX_SIFT_PX = 3.0
"""The same for SIFT matches, which are more exact."""
MIN_MATCH_SIMILARITY = 0.6
"""Smallest cosine of matched features."""
MIN_MATCHES = 30
"""Pairs with fewer mutual matches are ignored."""
RATIO = 0.9
"""Ratio test (Lowe, IJCV 2004): repeated texture would contradict right poses."""
NEIGHBOURS = 2.5
"""Radius around a match, in cells, inside which the ratio test compares no cells."""
STRIDE = 3
"""Step between the cells of the first frame that are matched."""


@frozen_arrays
class MatchedPair:
    """Two similar frames and their matches, without distortion."""

    first: int
    second: int
    """Numbers of the frames."""
    ray: Array
    """(n, 3) in the camera frame of the first, at depth 1."""
    pixels: Array
    """(n, 2) in the second, at working size."""


@frozen_arrays
class PoseCheck:
    """Frames that are not used."""

    wrong: IntArray
    """Their stated pose contradicts the images."""
    untracked: IntArray
    """Their images neither confirm nor contradict the stated pose."""
    share: float = 0.0
    """Of the pairs that contradict the stated poses."""

    @property
    def excluded(self) -> IntArray:
        """All of them."""
        return np.union1d(self.wrong, self.untracked)


def matched_pairs(recording: PreparedFrames) -> list[MatchedPair]:
    """Match every frame with the most similar ones; missing centroids are fitted to them."""
    features = [recording.features(i) for i in range(len(recording))]
    matched = []
    vlad = recording.encoder.vlad(features)
    for i, j in similar_pairs(features, vlad, PARTNERS):
        pair = _matched(recording, i, j)
        if len(pair.ray) >= MIN_MATCHES:
            matched.append(pair)
    return matched


def check_poses(
    recording: PreparedFrames,
    pairs: list[MatchedPair],
    confirmed: Collection[str] = (),
) -> PoseCheck:
    """Find frames whose stated pose contradicts most of their partners, unless it is confirmed."""
    count = len(recording)
    sift = _SiftCheck(recording)
    contradicts = contradicting(recording, pairs)
    frames = np.array([(pair.first, pair.second) for pair in pairs]).reshape(-1, 2)
    rest = np.ones(len(pairs), bool)
    wrong: list[int] = []
    untracked: list[int] = []
    while rest.any():
        total = np.bincount(frames[rest].ravel(), minlength=count)
        against = np.bincount(frames[rest & contradicts].ravel(), minlength=count)
        share = np.where(total >= 2, against / np.maximum(total, 1), 0)
        worst = int(np.lexsort((against, share))[-1])
        if share[worst] <= 0.5:
            break
        pairs_of_worst = (frames == worst).any(1)
        rest &= ~pairs_of_worst
        if recording.frames[worst].name in confirmed:
            continue
        partners = np.setdiff1d(frames[pairs_of_worst], [worst, *wrong, *untracked])
        agree, disagree = sift.votes(worst, partners.tolist())
        if not agree and not disagree:
            untracked.append(worst)
        elif agree < max(disagree, 1):
            wrong.append(worst)
    share = float(contradicts.sum() / max(len(pairs), 1))
    return PoseCheck(
        np.array(sorted(wrong), int), np.array(sorted(untracked), int), share
    )


def contradicting(recording: PreparedFrames, pairs: list[MatchedPair]) -> BoolArray:
    """(n,) pairs whose matches contradict the poses of the frames."""
    distances = [_distance(recording, pair) for pair in pairs]
    return np.array(distances) > MAX_DISTANCE_PX


class _SiftCheck:
    """Compares stated poses with SIFT matches that one essential matrix explains."""

    def __init__(self, recording: PreparedFrames):
        self.recording = recording
        self._features: dict[int, SiftFeatures] = {}

    def votes(self, frame: int, partners: Sequence[int]) -> tuple[int, int]:
        """Partners whose matches agree and disagree with the stated poses."""
        agree = 0
        disagree = 0
        for partner in partners:
            pair = self._pair(frame, partner)
            if not pair:
                continue
            if _distance(self.recording, pair) <= MAX_SIFT_PX:
                agree += 1
            else:
                disagree += 1
        return agree, disagree

    def _pair(self, i: int, j: int) -> MatchedPair | None:
        cameras = self.recording.cameras
        rays = epipolar_rays(self._of(i), self._of(j), cameras[i], cameras[j])
        if rays is None:
            return None
        camera = self.recording.cell_camera(j).pinhole
        return MatchedPair(i, j, rays[0], camera.project(rays[1]))

    def _of(self, frame: int) -> SiftFeatures:
        if frame not in self._features:
            self._features[frame] = sift_features(self.recording.grey[frame])
        return self._features[frame]


def depth_scale(
    recording: PreparedFrames,
    pairs: list[MatchedPair],
    metric: bool = True,
) -> float:
    """Estimate the usual depth relative to that in a room; 1 if the range of a room fits.

    Recordings have other scales if their unit of length is unknown (not `metric`: any range), on a
    wrist, or in a hall.
    Matches with clear parallax are triangulated.
    """
    depths = [_triangulated(recording, pair) for pair in pairs]
    return scale_of_depths(np.concatenate([np.zeros(0), *depths]), metric)


def scale_of_depths(depth: np.ndarray, metric: bool = True) -> float:
    """Return the factor of `depth_scale` for depths (n,) of a recording."""
    if len(depth) < MIN_DEPTHS:
        return 1.0
    near, middle, far = np.quantile(depth, [0.1, 0.5, 0.9])
    usual = metric and near > NEAR_M and far < FAR_M / 2
    return 1.0 if usual else float(middle / USUAL_M)


def _matched(
    recording: PreparedFrames,
    i: int,
    j: int,
) -> MatchedPair:
    """Mutual best matches of two frames."""
    features = recording.features(i)[::STRIDE]
    similar = features @ recording.features(j).T
    best = similar.argmax(1)
    back = similar.argmax(0)
    rows = np.arange(len(features))
    first = similar[rows, best]
    stride = recording.encoder.stride
    camera = recording.cell_camera(i)
    other = recording.cell_camera(j)
    mutual = back[best] == rows
    rows = rows[mutual & (first > MIN_MATCH_SIMILARITY)]
    apart = _apart(other.height // stride, other.width // stride)[best[rows]]
    second = np.where(apart, similar[rows], -1).max(1, initial=-1)
    distinct = 1 - first[rows] < RATIO**2 * (1 - second)
    rows = rows[distinct]
    pixels = ideal_cell_pixels(camera, stride)[rows * STRIDE]
    ray = camera.pinhole.unproject(pixels)
    matched = ideal_cell_pixels(other, stride)[best[rows]].astype(float)
    # Near the edge, the distortion can have no ray for a cell.
    valid = np.isfinite(ray).all(1) & np.isfinite(matched).all(1)
    return MatchedPair(
        i,
        j,
        ray[valid],
        matched[valid],
    )


@lru_cache(maxsize=4)
def _apart(rows: int, columns: int) -> BoolArray:
    """(cells, cells) whether two cells of a grid are no neighbours."""
    centres = cell_centres(rows, columns, 1)
    return cdist(centres, centres) > NEIGHBOURS


def _distance(recording: PreparedFrames, pair: MatchedPair) -> float:
    """Median distance of matches from the segments of their rays, pixels."""
    camera = recording.cell_camera(pair.second)
    scale = recording.depth_scale
    rotation, translation = recording.relative(pair.second, pair.first)
    ray = pair.ray @ rotation.T
    start = _pinhole(camera, ray + translation / (scale * FAR_M))
    end = _pinhole(camera, ray + translation / (scale * NEAR_M))
    return float(np.median(_segment_distance(pair.pixels, start, end)))


def _triangulated(recording: PreparedFrames, pair: MatchedPair) -> Array:
    """Depths of matches with clear parallax."""
    camera = recording.cell_camera(pair.second)
    rotation, translation = recording.relative(pair.second, pair.first)
    plane = camera.pinhole.unproject(pair.pixels)[:, :2]
    far = pair.ray @ rotation.T
    # The point (far + translation / depth) projects to the match: off + along / depth = 0.
    off = far[:, :2] - plane * far[:, 2:]
    along = translation[:2] - plane * translation[2]
    squares = (along**2).sum(1)
    inverse = -(off * along).sum(1) / np.maximum(squares, 1e-18)
    moved = inverse * norms(along)
    beside = norms(off + along * inverse[:, None])
    clear = moved * camera.fx > MIN_PARALLAX_PX
    epipolar = beside * camera.fx < MAX_EPIPOLAR_PX
    return 1 / inverse[clear & epipolar]


def _pinhole(camera: Camera, points: Array) -> Array:
    """Pixels (n, 2) of points (n, 3) without distortion; points behind are moved to the front."""
    depth = np.maximum(points[:, 2:], 1e-2)
    return camera.pinhole.project(np.concatenate([points[:, :2], depth], 1))


def _segment_distance(
    points: Array,
    start: Array,
    end: Array,
) -> Array:
    """Distances (n,) of points (n, 2) from segments between start (n, 2) and end (n, 2)."""
    along = end - start
    length = np.maximum((along**2).sum(1), 1e-12)
    share = (((points - start) * along).sum(1) / length).clip(0, 1)
    return norms(points - start - share[:, None] * along)
