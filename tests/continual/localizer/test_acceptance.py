"""Which poses are accepted: the threshold and the scale, from answers that are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from evercal.mapping.scene_maps import SceneMaps, SceneRecord, with_fit

from evercal.continual.networks.atlas import Atlas
from evercal.geometry.se3 import SE3
from evercal.localization import acceptance
from evercal.localization.estimate import PoseEstimate
from evercal.localization.localizer import Localizer
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera


@dataclass
class Answer:
    """What the fake localizer says of an image."""

    ratio: float
    truth: SE3 | None = None
    estimate: SE3 | None = None
    covariance: np.ndarray | None = None


def fit(
    monkeypatch: pytest.MonkeyPatch,
    blank: Callable[[str], SceneMaps],
    positives: Sequence[Answer],
    negatives: Sequence[float],
) -> tuple[float, float]:
    """`fit_threshold` with given answers to the held-out frames and to the negative images."""
    said = [*positives, *(Answer(ratio) for ratio in negatives)]

    class Fake:
        def __init__(self, maps: SceneMaps, *_: object) -> None:
            # What an earlier fit had found must not count twice.
            assert maps.scenes[0].covariance_scale == 1.0
            assert maps.scenes[0].inlier_threshold == 0.0

        def localize(self, image: np.ndarray, camera: object = None) -> PoseEstimate:
            number = int(image.ravel()[0]) + 256 * int(image.ravel()[1])
            a = said[number]
            status = "failed" if a.estimate is None else "ok"
            return PoseEstimate(status, "", "x", a.estimate, a.covariance, 9, a.ratio, 1.0)

    def image(number: int) -> np.ndarray:
        return np.array([[[number % 256, number // 256, 0]]], np.uint8)

    camera = default_camera(1, 1)
    frames = [Frame(str(i), image(i), camera, a.truth) for i, a in enumerate(positives)]
    unknown = [image(i) for i in range(len(positives), len(said))]
    with monkeypatch.context() as patch:
        patch.setattr(acceptance, "Localizer", Fake)
        patch.setattr(acceptance, "_negative_images", lambda *_: unknown)
        maps = blank("evercal_network")
        place = Atlas().place(np.zeros((1, 3)))
        record = SceneRecord("x", camera, place, torch.zeros(0, maps.descriptor.width), 30)
        maps.scenes.append(with_fit(record, 0.4, 5.0))
        return acceptance.fit_threshold(maps, frames)


def test_the_threshold_lies_a_sixth_of_the_way_up(
    monkeypatch: pytest.MonkeyPatch, blank: Callable[[str], SceneMaps]
) -> None:
    # 41 values in equal steps: the 5 % and 95 % quantiles are the 3rd and the 39th.
    positives = [Answer(0.5 + 0.01 * i) for i in range(41)]
    negatives = [0.001 * i for i in range(41)]
    threshold, _ = fit(monkeypatch, blank, positives[::-1], negatives)
    top, low = 0.038, 0.52
    assert threshold == pytest.approx(top + (low - top) / 6)
    assert max(negatives) < threshold < min(a.ratio for a in positives)


def test_negative_images_are_not_accepted_even_if_known_views_are_no_better(
    monkeypatch: pytest.MonkeyPatch, blank: Callable[[str], SceneMaps]
) -> None:
    threshold, _ = fit(monkeypatch, blank, [Answer(0.05)] * 8, [0.1] * 16)
    assert threshold == pytest.approx(0.1)


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 1.0), (3.0, 9.0), (0.2, 1.0)])
def test_the_scale_turns_claimed_covariance_into_found_errors(
    factor: float,
    expected: float,
    monkeypatch: pytest.MonkeyPatch,
    blank: Callable[[str], SceneMaps],
) -> None:
    rng = np.random.default_rng(0)
    positives = []
    for _ in range(600):
        truth = SE3.exp(rng.normal(0, 1, 6))
        root = rng.normal(0, 1, (6, 6)) * np.array([[0.002] * 3 + [0.001] * 3]).T
        error = factor * root @ rng.normal(0, 1, 6)
        # As documented: translation in the base frame, rotation about the camera's axes.
        turned = truth @ SE3.exp(np.array([0, 0, 0, *error[3:]]))
        estimate = SE3(turned.rotation_wxyz, truth.translation_m + error[:3])
        positives.append(Answer(0.5, truth, estimate, root @ root.T))
    for i in range(0, 600, 4):  # poses that are plainly wrong say nothing about precision
        truth = positives[i].truth
        assert truth is not None
        positives[i].estimate = SE3.exp(np.array([2.0, 0, 0, 1, 0, 0])) @ truth
    _, scale = fit(monkeypatch, blank, positives, [0.0])
    assert scale == pytest.approx(expected, rel=0.15)


def test_unknown_places_are_told_from_known_ones(
    arc_maps: tuple[SceneMaps, SceneMaps],
    arcs: tuple[Recording, Recording],
) -> None:
    maps = replace(arc_maps[0], scenes=list(arc_maps[0].scenes))
    fitted = acceptance.fit_threshold(maps, arcs[0].test[:8])
    maps.scenes[0] = with_fit(maps.scenes[0], *fitted)
    localizer, camera = Localizer(maps), default_camera(160, 120)
    right = [localizer.localize(frame.read_image()).status for frame in arcs[0].test[8:]]
    assert right.count("ok") >= 0.9 * len(right)
    room = BoxRoom(77, texture_px=96)
    views = [room.render(camera, room.random_view(np.random.default_rng(i))) for i in range(10)]
    views.append(np.random.default_rng(0).integers(0, 256, (120, 160, 3)).astype(np.uint8))
    wrong = [localizer.localize(view).status for view in views]
    assert wrong.count("ok") <= 1
