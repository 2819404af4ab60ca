"""Corrections that go together in places are taken back; noise is not."""

import numpy as np
from evercal.mapping.frame_correction import fit_correction

from evercal.geometry.se3 import SE3, pose_distance


def _walk(n: int, rng: np.random.Generator) -> SE3:
    steps = np.linspace(0, 6, n)
    place = np.stack([np.cos(steps), np.sin(steps), 0.1 * steps], -1)
    turn = np.stack([0.2 * np.sin(steps), 0.1 * steps, 0.3 * np.cos(steps)], -1)
    return SE3.exp(np.concatenate([place + 0.01 * rng.normal(size=(n, 3)), turn], 1))


def _bent(poses: SE3) -> np.ndarray:
    x, y, _ = poses.translation_m.T
    zero = np.zeros_like(x)
    return np.stack([0.01 * x, 0.01 * y, zero, 0.005 * y, zero, 0.005 * x], -1)


def test_smooth_corrections_are_taken_back() -> None:
    rng = np.random.default_rng(0)
    stated = _walk(200, rng)
    common = SE3.exp([0.02, 0, 0.01, 0.01, 0, 0])
    adjusted = stated @ common @ SE3.exp(_bent(stated))
    found = fit_correction(adjusted @ common.inverse(), _bent(stated))
    assert found is not None
    new = _walk(57, rng)
    true = new @ common @ SE3.exp(_bent(new))
    for pose, measured in zip(new, true, strict=True):
        plain = measured @ common.inverse()
        back = measured @ SE3.exp(-found.at(plain)) @ common.inverse()
        assert pose_distance(back, pose)[0] < 0.4 * pose_distance(plain, pose)[0]


def test_noise_is_not() -> None:
    rng = np.random.default_rng(1)
    stated = _walk(200, rng)
    noise = rng.normal(size=(200, 6)) * [0.002, 0.002, 0.002, 0.003, 0.003, 0.003]
    assert fit_correction(stated @ SE3.exp(noise), noise) is None


def test_nothing_is_taken_back_where_nothing_was_moved() -> None:
    stated = _walk(50, np.random.default_rng(2))
    assert fit_correction(stated, np.zeros((50, 6))) is None
