"""Rules that select keyframes, by name; most use features of the learned head.

Each rule selects frames of one scene up to a capacity. Rules designed for classes treat a scene as
a class and the mean over an image as its feature. All return sorted indices.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator

from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.geometry import norms, unit_vectors
from evercal.mapping.selection import UNITS, SarsOptions, select_sars
from evercal.typing import Array, IntArray

GSS_COMPARED = 10
"""Buffered frames with which gradient-based selection compares a new frame."""


def select_reservoir(count: int, capacity: int, rng: Generator) -> IntArray:
    """Reservoir sampling: every frame is selected with the same probability.

    Frames are appended until the buffer is full. Later the n-th frame draws one of n slots and
    replaces its frame if the slot is in the buffer (Vitter, 1985, algorithm R).
    """
    selected = list(range(min(count, capacity)))
    for frame in range(capacity, count):
        slot = int(rng.integers(frame + 1))
        if slot < capacity:
            selected[slot] = frame
    return _sorted(selected)


def select_herding(features: Array, capacity: int) -> IntArray:
    """Herding of iCaRL (Rebuffi et al., CVPR 2017, Algorithm 4).

    Each next frame is the one that brings the mean of the selection closest to the mean of all
    frames. Ties go to the earlier frame. The rows of features (n, c) are scaled to unit length.
    """
    unit = unit_vectors(features)
    if not len(unit):
        return _sorted([])
    mean = unit.mean(0)
    free = np.ones(len(unit), bool)
    total = np.zeros(unit.shape[1])
    selected = []
    for count in range(1, min(capacity, len(unit)) + 1):
        means = (total + unit) / count
        gap = norms(mean - means)
        frame = int(np.where(free, gap, np.inf).argmin())
        free[frame] = False
        total += unit[frame]
        selected.append(frame)
    return _sorted(selected)


def leverage_scores(features: Array, rank: int) -> Array:
    """Compute rank-r leverage: squared row norms of the first r left singular vectors of (n, c).

    The scores sum to the rank. FedCBDR prints the full left factor, whose rows all have norm 1; the
    thin one is used here.
    """
    double = np.asarray(features, float)
    left, values, _ = np.linalg.svd(double, full_matrices=False)
    floor = values.max(initial=0) * 1e-9
    used = min(rank, np.count_nonzero(values > floor))
    return (left[:, :used] ** 2).sum(1)


def select_leverage(features: Array, capacity: int, rng: Generator) -> IntArray:
    """Global-perspective data replay (GDR of FedCBDR, Qi et al., NeurIPS 2025) for one party.

    Frames are drawn without replacement, with probabilities proportional to their leverage.
    Encryption and bias weights, which serve several parties, are omitted.
    """
    # Frames without leverage can still fill the capacity.
    scores = leverage_scores(features, rank=32) + 1e-12
    shares = scores / scores.sum()
    count = min(capacity, len(scores))
    return np.sort(rng.choice(len(scores), size=count, replace=False, p=shares))


def select_coverage(
    visible: Sequence[IntArray], capacity: int, rng: Generator
) -> IntArray:
    """Coverage score of Buff-CS (Wang et al., ICCV 2021) inside one scene.

    Frames arrive in random order and are appended until the buffer is full. Later a frame enters if
    it shows a part of the scene that no buffered frame shows. Otherwise it enters with probability
    m / n as in a reservoir (m buffered, n earlier frames). Each entering frame replaces a random
    one, as in the released code. `visible` are the numbers of the parts that each frame shows.
    """
    if not capacity:
        return _sorted([])
    shows = [set(parts.tolist()) for parts in visible]
    selected = []
    for earlier, frame in enumerate(rng.permutation(len(visible)).tolist()):
        if len(selected) < capacity:
            selected.append(frame)
            continue
        covered = set().union(*(shows[i] for i in selected))
        is_novel = not shows[frame] <= covered
        if is_novel or rng.random() <= len(selected) / earlier:
            selected[int(rng.integers(len(selected)))] = frame
    return _sorted(selected)


def select_gradients(gradients: Array, capacity: int, rng: Generator) -> IntArray:
    """Gradient-based sample selection, greedy (GSS, Aljundi et al., NeurIPS 2019, Algorithm 2).

    A frame's score c is one plus its largest cosine with a few buffered frames. Frames are appended
    until the buffer is full. Later a frame enters only if c < 1, which means opposed gradients. It
    then replaces a buffered frame i, drawn by its score c_i, with probability c_i / (c_i + c). The
    gradients (n, p) are those of the loss on each frame.
    """
    unit = unit_vectors(gradients)
    selected = np.zeros(0, int)
    scores = np.zeros(0)
    if not capacity:
        return selected
    for frame, gradient in enumerate(unit):
        compared = selected[rng.permutation(len(selected))[:GSS_COMPARED]]
        cosine = -0.9
        if len(compared):
            cosine = float((unit[compared] @ gradient).max())
        score = cosine + 1.0
        if len(selected) < capacity:
            scores = np.append(scores, score)
            selected = np.append(selected, frame)
        elif score < 1.0:
            slot = 0
            total = scores.sum()
            if total > 0:
                slot = int(rng.choice(len(selected), p=scores / total))
            if rng.random() * (scores[slot] + score) < scores[slot]:
                selected[slot] = frame
                scores[slot] = score
    return np.sort(selected)


def _sorted(frames: list[int]) -> IntArray:
    return np.sort(np.array(frames, np.int64))


Select = Callable[[FrameStatistics, int], IntArray]
"""Maps the frames of a finished scene and a capacity to sorted indices of the keyframes."""


def _sars(options: SarsOptions) -> Select:
    def select(frames: FrameStatistics, capacity: int) -> IntArray:
        poses = frames.positions_m, frames.quaternions_wxyz
        return select_sars(*poses, capacity, options)

    return select


SELECTORS: dict[str, Select] = {
    "reservoir": lambda f, capacity: select_reservoir(len(f), capacity, f.rng()),
    "herding": lambda f, capacity: select_herding(f.features(), capacity),
    "coverage": lambda f, capacity: select_coverage(
        f.visible_parts(), capacity, f.rng()
    ),
    "leverage": lambda f, capacity: select_leverage(f.features(), capacity, f.rng()),
    "gradients": lambda f, capacity: select_gradients(f.gradients(), capacity, f.rng()),
    "sars": _sars(SarsOptions()),
    "sars_filled": _sars(SarsOptions(fill=True)),
    **{f"sars_{unit}": _sars(SarsOptions(unit=unit)) for unit in UNITS},
}
"""`sars` has the paper's fixed radius, `sars_filled` a radius that fills the memory, and the others
the fixed radius with another unit of positions, see `UNITS`."""
