"""Data sets of many episodes that state the poses of fixed cameras, read episode by episode."""

from collections.abc import Iterator
from pathlib import Path

from evercal.recordings.episodes import droid, of_lerobot
from evercal.recordings.episodes.episode import Episode
from evercal.recordings.formats import lerobot
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel


def episodes_in(
    root: Path, model: RobotModel, camera: Path, options: ReadOptions, images: int
) -> tuple[int, Iterator[Episode]]:
    """Number of episodes times cameras of a data set, and an iterator over them.

    Args:
        root: Folder of a LeRobot data set, or one in DROID's layout.
        model: The robot.
        camera: File of the intrinsics.
        options: `image_topic` is the only camera; `pose_convention` is rad or deg of joint values.
        images: Images of an episode.
    """
    if lerobot.detect(root):
        return of_lerobot.episodes(root, model, camera, options, images)
    return droid.episodes(root, model, camera, options, images)
