"""Scenes that map the place of an image in another base, and whether the image tells them apart.

A cell is learned again after its robot was moved, two robots share a place, or cells look alike.
Learning has found which scenes these are and where their bases lie, so the pose in one scene
predicts that in each other one. An image decides only where landmarks of a scene are missing in it:
things were moved, or it is another cell.
"""

from dataclasses import field
from typing import Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.geometry import SE3
from evercal.localization.hypothesis import Aligned, accepted
from evercal.localization.intrinsics import INTRINSICS
from evercal.localization.query import Candidate, Query
from evercal.localization.scene_poses import ScenePoses
from evercal.mapping.scene_map import SceneMap, base_from_other_base, same_base

FAR_BETTER = 0.5
"""An image excludes a scene whose inlier ratio is below this share of that in another one."""
FEW = 60
"""Landmarks that should be visible; with fewer of them an image excludes no scene."""


@frozen_arrays
class InBase:
    """The camera of an image in the base of one scene."""

    scene: SceneMap
    pose: SE3
    """base_from_camera."""
    aligned: Aligned | None = field(default=None, repr=False)
    """The accepted pose among its landmarks, if there is one."""
    expected: int = 0
    """Landmarks that should be visible."""

    @classmethod
    def of(cls, scene: SceneMap, aligned: Aligned) -> Self:
        """The camera at an accepted pose in a scene."""
        pose = scene.frame.to_base(aligned.pose).pose
        return cls(scene, pose, aligned, aligned.expected)

    @property
    def inlier_ratio(self) -> float:
        """Of the accepted pose; 0 without one."""
        return self.aligned.inlier_ratio if self.aligned else 0.0


def in_other_base(
    poses: ScenePoses, query: Query, best: Aligned
) -> tuple[Aligned, InBase | None]:
    """The pose in the scene that explains an image best, and one in another base.

    The second one is None if the image excludes it, or if no scene is in another base.
    """
    scenes = poses.contents.scenes
    others = sorted(poses.bank.scenes - {best.scene})
    if not others:
        return best, None
    own = InBase.of(scenes[best.scene], best)
    views = [own]
    for number in others:
        scene = scenes[number]
        between = base_from_other_base(scene, own.scene)
        if between and not same_base(scene, own.scene):
            views.append(_in_base(poses, query, number, between @ own.pose))
    likeliest = max(views, key=lambda view: view.inlier_ratio)
    for view in views:
        if same_base(view.scene, likeliest.scene):
            continue
        least = FAR_BETTER * likeliest.inlier_ratio
        if view.inlier_ratio >= least or view.expected < FEW:
            return likeliest.aligned or best, view
    return likeliest.aligned or best, None


def _in_base(poses: ScenePoses, query: Query, number: int, predicted: SE3) -> InBase:
    """The image in another scene, from its predicted pose base_from_camera."""
    scene = poses.contents.scenes[number]
    start = scene.frame.from_base(predicted)
    counts = poses.bank.shown(number, start, query.cameras[number])
    candidate = Candidate(number, counts.keyframes[: poses.options.keyframes])
    aligned = poses.aligned(query, candidate, start, np.zeros(INTRINSICS))
    if not aligned or not accepted(aligned):
        return InBase(scene, predicted, None, counts.landmarks)
    return InBase.of(scene, aligned)
