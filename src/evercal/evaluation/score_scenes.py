"""`evercal.evaluate`: the scores that `evercal evaluate` prints."""

import os
from collections.abc import Mapping, Sequence

from evercal.errors import InputError
from evercal.evaluation.metrics import Scores, scores
from evercal.evaluation.protocol import SceneLocalizer
from evercal.evaluation.protocol import evaluate as frame_results
from evercal.recordings import Recording, load_recording

Recorded = str | os.PathLike[str] | Recording
"""The folder of a recorded scene, or the scene itself."""


def evaluate(
    localizer: SceneLocalizer, scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded]
) -> Scores:
    """Accuracy on the test frames of scenes, mixed, without telling which is from where.

    Args:
        localizer: that was taught these scenes, and maybe others.
        scenes: one or more, as folders or as scenes; by name where the localizer knows them by
            another name than their own.

    Returns:
        Scores of each scene and their means.

    Raises:
        InputError: no scene, one name twice, or as `evaluation.protocol.evaluate`.
    """
    return scores(frame_results(localizer, _named(scenes)))


def _named(scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded]) -> dict[str, Recording]:
    if isinstance(scenes, Mapping):
        return {name: _loaded(scene) for name, scene in scenes.items()}
    given = [scenes] if isinstance(scenes, str | os.PathLike | Recording) else scenes
    named: dict[str, Recording] = {}
    for recorded in given:
        scene = _loaded(recorded)
        if scene.name in named:
            raise InputError(
                f"scene {scene.name!r}: given twice; tell them apart by name, as in"
                f" {{'name under which it was learned': scene}}"
            )
        named[scene.name] = scene
    return named


def _loaded(scene: Recorded) -> Recording:
    return scene if isinstance(scene, Recording) else load_recording(scene)
