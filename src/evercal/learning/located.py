"""Frames of a recording, located in the map of its scene alone.

The other scenes of the map are left out, so that what is learned does not depend on them.
"""

from collections.abc import Sequence

from evercal.geometry import SE3
from evercal.localization.answer import differ
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.recordings.frame import Frame


def localizer_of(contents: MapContents, scene: SceneMap) -> Localizer:
    """A localizer of one scene, with the encoder of `contents`."""
    return Localizer(contents.empty().with_scene(scene))


def located_poses(localizer: Localizer, frames: Sequence[Frame]) -> list[SE3 | None]:
    """Pose of each frame in the frame of the scene; None of those that are not located."""
    poses = []
    for frame in frames:
        estimate = localizer.localize(frame.read_image(), frame.camera)
        poses.append(estimate.base_from_camera)
    return poses


def located_as_stated(localizer: Localizer, frames: Sequence[Frame]) -> tuple[str, ...]:
    """Names of the posed frames that are located where their poses say."""
    [scene] = localizer.contents.scenes
    names = []
    for frame in frames:
        estimate, pose = localizer.located(frame.read_image(), frame.camera)
        assert frame.base_from_camera is not None, "a posed frame"
        stated = scene.frame.from_base(frame.base_from_camera)
        if estimate.status != "ok" or pose is None or differ(pose, stated):
            continue
        names.append(frame.name)
    return tuple(names)
