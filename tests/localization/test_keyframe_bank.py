"""The keyframes of a map: retrieval, the limit on decoded keyframes, and their landmarks."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier

import numpy as np
import pytest

from evercal.features.encoder import Encoder
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.mapping.scene_map import MapContents
from evercal.typing import Float32Array, Image


@pytest.fixture(scope="module")
def several(hall_map: MapContents) -> MapContents:
    """Three scenes with the same seven keyframes."""
    scene = hall_map.scenes[0]
    scenes = [replace(scene, name=name) for name in ("a", "b", "c")]
    return MapContents(hall_map.encoder, hall_map.short_side, scenes)


def features(seed: int, contents: MapContents) -> Float32Array:
    drawn = np.random.default_rng(seed).normal(size=(300, contents.encoder.width))
    return (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype(np.float32)


def test_retrieval_ranks_the_keyframes_of_all_scenes(several: MapContents) -> None:
    bank = KeyframeBank(several, 9)
    descriptors = several.scenes[1].keyframes.descriptors
    assert len(bank.scene) == 21
    assert descriptors is not None
    for seed in range(5):
        query = features(seed, several)
        vlad = several.encoder.vlad()(query)
        similarity = [float(row.astype(np.float32) @ vlad) for row in descriptors] * 3
        (mine,) = bank.similarity(vlad)
        np.testing.assert_allclose(mine, similarity, atol=1e-6)
        ranked = bank.ranked(mine, 21).tolist()
        assert sorted(ranked) == list(range(21))
        values = [similarity[i] for i in ranked]
        np.testing.assert_allclose(values, sorted(values, reverse=True), atol=1e-6)
        for most in (1, 5, 30):
            assert bank.ranked(mine, most).tolist() == ranked[:most]
        of_second = [i for i in ranked if 7 <= i < 14]
        assert bank.ranked_of(1, mine).tolist() == of_second


def test_keyframes_that_are_not_in_use_are_not_ranked(several: MapContents) -> None:
    part = KeyframeBank(several, 9).only(np.array([3, 8, 20]))
    query = features(0, several)
    (similarity,) = part.similarity(several.encoder.vlad()(query))
    assert sorted(part.ranked(similarity, 12).tolist()) == [3, 8, 20]
    assert part.ranked_of(1, similarity).tolist() == [8]


@pytest.mark.parametrize("most", [1, 3, 7])
def test_least_recently_used_keyframes_are_dropped(
    most: int, hall_map: MapContents
) -> None:
    bank = KeyframeBank(hall_map, most)
    rng = np.random.default_rng(0)
    recent: dict[int, object] = {}
    dropped: list[object] = []
    for index in rng.integers(0, 7, 25).tolist():
        loaded = bank.load(index)
        expected = recent.pop(index, None)
        assert expected is None or loaded is expected
        assert expected is not None or loaded not in dropped
        recent[index] = loaded
        if len(recent) > most:
            dropped.append(recent.pop(next(iter(recent))))


def test_landmarks_project_to_their_pixels(hall_map: MapContents) -> None:
    bank = KeyframeBank(hall_map, 9)
    keyframes = hall_map.scenes[0].keyframes
    for i, landmarks in enumerate(keyframes.landmarks):
        loaded = bank.load(i).landmarks
        pose = keyframes.base_from_camera[i]
        pixels = keyframes.cameras[i].project(pose.inverse().apply(loaded.surface_m[0]))
        np.testing.assert_allclose(pixels, landmarks.pixels, atol=1e-6)
        np.testing.assert_array_equal(loaded.position_m, pose.translation_m)
        cells = bank.load(i).cells
        assert len(cells.points_m) == len(cells.features) == 30 * 40
        assert (
            len(loaded.depth_noise)
            == len(landmarks)
            == len(loaded.patches[0].templates)
        )


class Counted(Encoder):
    """An encoder that counts its calls and can wait for another thread in them."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__(encoder.function, encoder.name, encoder.data)
        self.barrier: Barrier | None = None
        self.calls = 0

    def __call__(self, grey: Image) -> Float32Array:
        self.calls += 1
        if self.barrier is not None:
            self.barrier.wait()
        return super().__call__(grey)


def counted(hall_map: MapContents) -> tuple[KeyframeBank, Counted]:
    encoder = Counted(hall_map.encoder)
    return KeyframeBank(replace(hall_map, encoder=encoder), 9), encoder


def test_keyframes_are_encoded_once_and_on_demand(hall_map: MapContents) -> None:
    bank, encoder = counted(hall_map)
    keyframe = bank.load(0)
    assert keyframe.landmarks is keyframe.landmarks
    assert encoder.calls == 0
    assert keyframe.cells is bank.load(0).cells
    assert encoder.calls == 1


def test_threads_load_different_keyframes_at_once(hall_map: MapContents) -> None:
    # The barrier breaks if the second thread waits until the first one has finished.
    bank, encoder = counted(hall_map)
    encoder.barrier = Barrier(2, timeout=20)
    with ThreadPoolExecutor(2) as pool:
        cells = list(pool.map(lambda i: bank.load(i).cells, (0, 1)))
    assert not np.array_equal(cells[0].features, cells[1].features)
