"""A localizer whose network has learned next to nothing, and whose memory answers."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from evercal.mapping.scene_maps import SceneMaps

from evercal.continual.learn import learn
from evercal.continual.networks.descriptor import load_descriptor
from evercal.continual.stage import Stage
from evercal.continual.strategies import STRATEGIES
from evercal.features.encoder import load_encoder
from evercal.localization.localizer import LocalizeOptions, Localizer
from evercal.mapping.keyframes import Keyframes

if TYPE_CHECKING:
    from evercal.continual.stage import StageOptions
    from evercal.localization.estimate import PoseEstimate
    from evercal.recordings import Recording


@pytest.fixture(scope="module")
def unlearned(arcs: tuple[Recording, Recording], arc_stage: StageOptions) -> SceneMaps:
    """The first arc after a dozen steps; half of its frames are remembered."""
    fit = replace(arc_stage.fit, iterations=12)
    options = replace(arc_stage, fit=fit, memory_share=0.5)
    blank = SceneMaps(load_encoder(), load_descriptor(), "evercal_hybrid", 120)
    *_, stage = learn(blank, STRATEGIES["evercal_hybrid"], arcs[0], options)
    assert isinstance(stage, Stage)
    return stage.maps


def without_map(keyframes: Keyframes) -> Keyframes:
    """The images alone."""
    return replace(keyframes, inverse_depth=(), landmarks=(), descriptors=None)


def located(maps: SceneMaps, scene: Recording) -> tuple[list[PoseEstimate], float]:
    """Answers for every third test frame, and their median error in metres."""
    localizer, answers, errors = Localizer(maps), [], []
    for frame in scene.test[::3]:
        found = localizer.localize(frame.read_image(), frame.camera)
        answers.append(found)
        pose, truth = found.base_from_camera, frame.base_from_camera
        assert truth is not None
        lost = pose is None
        errors.append(np.inf if lost else np.linalg.norm(pose.translation_m - truth.translation_m))
    return answers, float(np.median(errors))


def test_remembered_frames_answer_where_the_network_cannot(
    unlearned: SceneMaps, arcs: tuple[Recording, Recording]
) -> None:
    keyframes = unlearned.keyframes[0]
    assert keyframes is not None
    assert len(keyframes.inverse_depth) == len(keyframes.images) == 12
    answers, error_m = located(unlearned, arcs[0])
    assert error_m < 0.05
    for found in answers:
        assert 0 <= found.inlier_ratio <= 1  # a cell counts once, though two sources answer for it
        if found.status == "ok":
            assert found.pixels is not None
            assert found.points_m is not None
            assert len(found.pixels) == len(found.points_m) >= found.inliers
    alone = replace(unlearned, keyframes=[None])
    assert located(alone, arcs[0])[1] > 0.2
    # Without a map, as other strategies have it, nothing is recalled.
    plain = replace(unlearned, keyframes=[without_map(keyframes)])
    assert located(plain, arcs[0])[1] == located(alone, arcs[0])[1]


def test_a_batch_says_the_same(unlearned: SceneMaps, arcs: tuple[Recording, Recording]) -> None:
    frames = arcs[0].test[:4]
    localizer = Localizer(unlearned)
    batch = localizer.localize_batch([f.read_image() for f in frames], [f.camera for f in frames])
    for frame, found in zip(frames, batch, strict=True):
        single = Localizer(unlearned).localize(frame.read_image(), frame.camera)
        assert (found.status, found.inliers) == (single.status, single.inliers)


def test_remembered_cells_vote_for_the_scene(
    unlearned: SceneMaps, arcs: tuple[Recording, Recording], arc_stage: StageOptions
) -> None:
    options = replace(
        arc_stage,
        fit=replace(arc_stage.fit, iterations=12),
        memory_share=0.5,
        replay_views_per_frame=1,
    )
    *_, stage = learn(unlearned, STRATEGIES["evercal_hybrid"], arcs[1], options)
    assert isinstance(stage, Stage)
    maps = stage.maps
    # Descriptors that say the opposite of the truth.
    first, second = maps.scenes
    maps.scenes = [
        replace(first, prototypes=second.prototypes),
        replace(second, prototypes=first.prototypes),
    ]
    only = LocalizeOptions(candidates=1)

    def right(maps: SceneMaps) -> int:
        localizer = Localizer(maps, only)
        return sum(
            localizer.localize(frame.read_image(), frame.camera).scene == scene.name
            for scene in arcs
            for frame in scene.test[::4]
        )

    assert right(maps) >= 11  # of 12
    # Without a map nothing is recalled, and the descriptors decide.
    maps.keyframes = [m and without_map(m) for m in maps.keyframes]
    assert right(maps) == 0
