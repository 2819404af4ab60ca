"""Whether the place of a new scene is mapped already, and where the other scene has its base."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import (
    SE3,
    Camera,
    UncertainPose,
    average_poses,
    pose_distance,
    spread,
)
from evercal.learning.report import SamePlace
from evercal.localization.acceptance import APART_M, APART_RAD, APART_SIGMAS
from evercal.localization.localizer import Localizer
from evercal.localization.options import LocalizeOptions
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.typing import Image

VIEWS = 8
"""Keyframes of a new scene that are located in the others."""
LEAST = 2
"""Keyframes that agree on another scene before it counts as one of the same place."""
AGREE_M = 0.03
"""Distance from their median within which they agree on the other base, metres."""
AGREE_RAD = np.deg2rad(3.0)
"""The same angle."""
SAME_M = 0.001
"""Bases that are nearer to each other, metres, are one."""
SAME_RAD = np.deg2rad(0.1)
"""The same angle."""


@frozen_arrays
class _Relation:
    """Another scene of the same place."""

    scene: SceneMap
    other_from_base: SE3
    """Pose of the new scene's base in the base of the other one."""
    metres: float
    """Median distance of cameras between the bases."""
    radians: float
    same: bool
    """Whether the bases agree, to the uncertainty of both maps."""

    @property
    def record(self) -> SamePlace:
        """What the report of the new scene says of it."""
        degrees = float(np.rad2deg(self.radians))
        mm = 1000 * float(self.metres)
        return SamePlace(self.scene.name, self.scene.base, mm, degrees, self.same)


def placed(
    scene: SceneMap, contents: MapContents
) -> tuple[SceneMap, tuple[SamePlace, ...]]:
    """A new scene in the places that a map shows already, or in one of its own; and its scenes.

    Raises:
        InputError: The poses of a scene in the base of this name are far from its poses.
    """
    if scene.places.keys() & {place for o in contents.scenes for place in o.places}:
        return scene, ()
    places: dict[str, SE3] = {}
    others = []
    for other in _mapped_already(contents, scene):
        record = other.record
        far = other.metres > APART_M or other.radians > APART_RAD
        if far and not other.same and scene.base and scene.base == record.base:
            raise InputError(
                f"scene {scene.name!r}: {record.distance} from the poses of {record.scene} in base"
                f" {scene.base!r}: the base or most things were moved (`replace`), or it is another"
                " base (`base`)"
            )
        others.append(record)
        for place, place_from_other in other.scene.places.items():
            pose = place_from_other
            if not other.same:
                pose = place_from_other @ other.other_from_base
            places.setdefault(place, pose)
    return replace(scene, places=places or scene.own_place), tuple(others)


def _mapped_already(contents: MapContents, scene: SceneMap) -> list[_Relation]:
    if not contents.scenes:
        return []
    # The first attempt finds what a recording of the same place shows.
    options = LocalizeOptions(attempts=LocalizeOptions().attempts[:1])
    localizer = Localizer(contents, options)
    shown: set[str] = set()
    for view in _views(scene):
        estimate = localizer.localize(*view.image)
        shown.update(estimate.alternatives_in)
        shown.update([estimate.scene] if estimate.scene else [])
    places = {place for name in shown for place in contents.scene(name).places}
    found = []
    for other in contents.scenes:
        near = other.name in shown or places & other.places.keys()
        if near and other.parent_frame == scene.parent_frame:
            relation = _relation(localizer.within([other.name]), scene, other)
            found += [relation] if relation else []
    return found


class _View(NamedTuple):
    """A keyframe of a new scene, and its camera in the scene's base."""

    image: tuple[Image, Camera]
    base_from_camera: UncertainPose


def _views(scene: SceneMap) -> Iterator[_View]:
    frames = scene.keyframes
    for i in spread(len(frames), VIEWS):
        pose = scene.frame.to_base(UncertainPose.exact(frames.base_from_camera[i]))
        yield _View((frames.grey(i), frames.cameras[i]), pose)


def _relation(
    localizer: Localizer, scene: SceneMap, other: SceneMap
) -> _Relation | None:
    """Where another scene has its base, if enough views of a scene agree on that."""
    pairs = []
    for view in _views(scene):
        pose = localizer.localize(*view.image).uncertain_pose
        if pose:
            pairs.append((view.base_from_camera, pose))
    if not pairs:
        return None
    bases = SE3.stack([pose.pose @ own.pose.inverse() for own, pose in pairs])
    other_from_base = average_poses(bases)
    metres, radians = pose_distance(bases, other_from_base)
    agree = np.flatnonzero((metres < AGREE_M) & (radians < AGREE_RAD))
    if len(agree) < LEAST:
        return None
    squares = []
    distances = []
    for own, pose in (pairs[i] for i in agree):
        both = UncertainPose(own.pose, own.covariance + pose.covariance)
        squares.append(both.squared_mahalanobis(pose.pose))
        distances.append(pose_distance(own.pose, pose.pose))
    far_m, far_rad = np.median(distances, 0)
    near = far_m < SAME_M and far_rad < SAME_RAD
    same = near or np.median(squares) < APART_SIGMAS**2
    return _Relation(other, other_from_base, far_m, far_rad, bool(same))
