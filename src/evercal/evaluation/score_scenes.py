"""`evercal.evaluate`: the scores that `evercal evaluate` prints."""

import os
from collections.abc import Mapping, Sequence

from evercal.errors import InputError
from evercal.evaluation.metrics import Scores, scores
from evercal.evaluation.protocol import SceneLocalizer
from evercal.evaluation.protocol import evaluate as frame_results
from evercal.recordings import Recording, load_recording

Recorded = str | os.PathLike[str] | Recording
"""A recording, or its folder."""


def evaluate(
    localizer: SceneLocalizer, scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded]
) -> Scores:
    """Evaluate a localizer on the test frames of scenes, in random order.

    Args:
        localizer: A localizer that learned these scenes, and possibly others.
        scenes: One or more recordings or their folders. Give a mapping if the localizer has other
            names for them.

    Returns:
        Scores of each scene and their means.
    """
    return scores(frame_results(localizer, _named(scenes)))


def _named(scenes: Recorded | Sequence[Recorded] | Mapping[str, Recorded]) -> dict[str, Recording]:
    if isinstance(scenes, Mapping):
        return {name: _loaded(scene) for name, scene in scenes.items()}
    given = [scenes] if isinstance(scenes, str | os.PathLike | Recording) else scenes
    named: dict[str, Recording] = {}
    for scene in map(_loaded, given):
        if scene.name in named:
            raise InputError(
                f"scene {scene.name!r}: given twice; give a mapping of the names under which they"
                " were learned"
            )
        named[scene.name] = scene
    return named


def _loaded(scene: Recorded) -> Recording:
    return scene if isinstance(scene, Recording) else load_recording(scene)
