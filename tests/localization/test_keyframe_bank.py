"""The keyframes of a map: who is found, who stays in memory, where the landmarks are."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Barrier
from typing import Any

import numpy as np
import pytest
import torch

from evercal.features.vlad import vlad_for
from evercal.localization import keyframe_bank as module
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.mapping.scene_maps import SceneMaps


@pytest.fixture(scope="module")
def several(hall_maps: SceneMaps) -> SceneMaps:
    """Four scenes: two with keyframes of the hall, two without a map."""
    keyframes = hall_maps.keyframes[0]
    assert keyframes is not None
    plain = replace(keyframes, descriptors=None, landmarks=(), inverse_depth=())
    mixed = [None, keyframes, plain, keyframes]
    return replace(hall_maps, scenes=hall_maps.scenes * 4, keyframes=mixed)


def features(seed: int, maps: SceneMaps) -> torch.Tensor:
    drawn = torch.randn(300, maps.encoder.width, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(drawn, dim=1)


def test_only_scenes_with_a_map_are_in_the_bank(several: SceneMaps) -> None:
    bank = KeyframeBank(several, 9)
    assert len(bank) == 14
    assert bank.scene.tolist() == [1] * 7 + [3] * 7
    none = KeyframeBank(replace(several, keyframes=[None] * 4), 9)
    assert len(none) == 0
    assert len(none.retrieve(features(0, several), [0, 1])) == 0


@pytest.mark.parametrize("scenes", [[1, 3], [3], [0, 2], []])
def test_retrieval_is_a_search_of_all(scenes: list[int], several: SceneMaps) -> None:
    bank, keyframes = KeyframeBank(several, 9), several.keyframes[1]
    assert keyframes is not None
    assert keyframes.descriptors is not None
    for seed in range(5):
        query = features(seed, several)
        whole = vlad_for(several.encoder)(query)
        likeness = [float(row.float() @ whole) for row in keyframes.descriptors] * 2
        mine = [i for i in range(14) if bank.scene[i] in scenes]
        found = bank.retrieve(query, scenes).tolist()
        assert sorted(found) == mine
        # Both scenes hold the same keyframes, so two are always equally alike.
        values = [likeness[i] for i in found]
        np.testing.assert_allclose(values, sorted(values, reverse=True), atol=1e-6)


def test_a_keyframe_finds_itself(hall_maps: SceneMaps) -> None:
    bank = KeyframeBank(hall_maps, 9)
    for i in range(len(bank)):
        assert bank.retrieve(bank.load(i).cells.features.float(), [0])[0] == i


@pytest.mark.parametrize("most", [1, 3, 7])
def test_no_more_keyframes_stay_in_memory_than_allowed(most: int, hall_maps: SceneMaps) -> None:
    bank, rng = KeyframeBank(hall_maps, most), np.random.default_rng(0)
    recent: list[int] = []
    reads: list[int] = []
    read = bank._read
    bank._read = lambda scene, number: reads.append(number) or read(scene, number)  # type: ignore[method-assign]
    for index in rng.integers(0, 7, 25).tolist():
        known, before = index in recent, len(reads)
        bank.load(index)
        # The last ones used are those that stay.
        recent = [*(i for i in recent if i != index), index][-most:]
        assert len(reads) == before + (not known)
        assert list(bank._loaded) == recent


def test_what_was_dropped_comes_back_the_same(hall_maps: SceneMaps) -> None:
    bank = KeyframeBank(hall_maps, 1)
    one, _, again = bank.load(2), bank.load(3), bank.load(2)
    assert one is not again
    assert torch.equal(one.cells.features, again.cells.features)
    np.testing.assert_array_equal(one.cells.points_m, again.cells.points_m)
    for name in ("surface_m", "depth_noise", "position_m"):
        before, after = (getattr(keyframe.landmarks, name) for keyframe in (one, again))
        np.testing.assert_array_equal(before, after)


def test_landmarks_stand_where_their_keyframe_sees_them(hall_maps: SceneMaps) -> None:
    bank, keyframes = KeyframeBank(hall_maps, 9), hall_maps.keyframes[0]
    assert keyframes is not None
    for i, marks in enumerate(keyframes.landmarks):
        loaded, pose = bank.load(i).landmarks, keyframes.base_from_camera[i]
        seen = keyframes.cameras[i].project(pose.inverse().apply(loaded.surface_m[0]))
        np.testing.assert_allclose(seen, marks.pixels, atol=1e-6)
        np.testing.assert_array_equal(loaded.position_m, pose.translation_m)
        cells = bank.load(i).cells
        assert len(cells.points_m) == len(cells.features) == 30 * 40
        assert len(loaded.depth_noise) == len(marks) == len(loaded.patches[0].intensity)


def test_only_what_is_asked_for_is_made(
    hall_maps: SceneMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    for name in ("encode_features", "cut_patches"):
        whole = getattr(module, name)
        monkeypatch.setattr(
            module, name, lambda *a, name=name, whole=whole: made.append(name) or whole(*a)
        )
    keyframe = KeyframeBank(hall_maps, 9).load(0)
    assert made == []
    assert keyframe.cells is keyframe.cells
    assert made == ["encode_features"]
    assert keyframe.landmarks is keyframe.landmarks
    assert made == ["encode_features", "cut_patches", "cut_patches"]


def test_threads_read_other_keyframes_meanwhile(
    hall_maps: SceneMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    bank, whole, both = KeyframeBank(hall_maps, 9), module.encode_features, Barrier(2, timeout=20)

    def together(*words: Any) -> torch.Tensor:
        both.wait()  # raises where the second thread is kept waiting until the first is done
        return whole(*words)

    monkeypatch.setattr(module, "encode_features", together)
    with ThreadPoolExecutor(2) as pool:
        cells = list(pool.map(lambda i: bank.load(i).cells, (0, 1)))
    assert not torch.equal(cells[0].features, cells[1].features)
