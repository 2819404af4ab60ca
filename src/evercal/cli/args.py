"""Arguments that several verbs share, and what they stand for."""

import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, TextIO

from tyro.conf import Positional, UseAppendAction, arg

from evercal.bounds import VARIABLE, bounds
from evercal.classes import frozen
from evercal.cli.console import print_json, print_next, say
from evercal.errors import InputError
from evercal.processes import cores
from evercal.robot.frame_names import FrameNames

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.geometry import SE3, Camera, UncertainPose
    from evercal.localization.localizer import Localizer
    from evercal.recordings import Recording
    from evercal.reports.inspected import LearnedLocalizer
    from evercal.robot.pose_errors import ArmErrors
    from evercal.typing import Size, Strings

MAP = "evercal"
"""The strategy of a map."""


def shown(word: str, default: str = "", **how: Any) -> Any:
    """An argument with a placeholder for its value and its default, as the help shows them."""
    return arg(metavar=word, help_behavior_hint=default, **how)


Store = Annotated[Positional[Path], arg(metavar="MAP", help="Folder of the map.")]
ImageFiles = Annotated[Positional[tuple[Path, ...]], shown("IMAGE...")]
OptionalImages = Annotated[Positional[tuple[Path, ...]], shown("[IMAGE...]")]
File = Annotated[Path | None, shown("FILE")]
Folder = Annotated[Path | None, shown("DIR")]
Name = Annotated[str | None, shown("NAME")]
Frame = Annotated[str | None, shown("FRAME")]
Scenes = Annotated[
    tuple[str, ...],
    UseAppendAction,
    shown(
        "NAME",
        "(default: all)",
        help="Locate images in this scene only; repeat it for several.",
    ),
]
Source = Annotated[str | None, shown("SOURCE")]
Topic = Annotated[str | None, shown("TOPIC")]
Seconds = Annotated[float | None, shown("SECONDS")]
Count = Annotated[int | None, shown("N")]
Number = Annotated[int, arg(metavar="N")]
OutFile = Annotated[Path, arg(metavar="FILE")]
InFile = OutFile
InFolder = Annotated[Positional[Path], arg(metavar="DIR")]
NewFolder = Annotated[Positional[Path], arg(metavar="OUT")]
SceneName = Annotated[Positional[str], arg(metavar="SCENE")]
OutFolder = Annotated[Path, arg(metavar="DIR")]
Host = Annotated[
    str, arg(metavar="H", help="Address to listen on, such as 0.0.0.0 for all.")
]
Port = Annotated[int, arg(metavar="P", help="Port to listen on; 0 for any free one.")]
At = Annotated[
    str | None,
    shown(
        "X,Y,Z",
        help="A point in the camera frame (x right, y down, z forward; metres), such as an object"
        " that the camera sees: its standard deviation in the base or gripper frame is stated.",
    ),
]
Poses = Annotated[
    str,
    arg(
        metavar="original|colour|PATH",
        help="Poses of 7-Scenes and 12-Scenes: as published; those of the colour camera (7-Scenes);"
        " or a folder of poses by structure from motion (Brachmann et al., ICCV 2021). Of other"
        " folders of images: the file or folder of the camera's poses.",
    ),
]
Address = Annotated[str | None, shown("ADDRESS")]
Device = Annotated[
    Literal["auto", "cpu", "cuda"],
    arg(
        help="Device of networks (not of a map); auto uses a CUDA device if there is one."
    ),
]


@dataclass(frozen=True, kw_only=True)
class Verb:
    """A verb with its arguments."""

    writes: ClassVar[tuple[str, ...]] = ()
    """Arguments that name what a verb writes, where it keeps what made it; the result first."""
    json: bool = False
    """Print one JSON object."""
    limits: Annotated[str, shown("NAME=N,...", "(default: none)")] = ""
    """Read larger files than usual; a refusal names the limit, such as pixels or text_bytes."""

    def run(self) -> int:
        """Run and return the exit code."""
        raise NotImplementedError

    @property
    def given(self) -> dict[str, Any]:
        """All arguments but those that name what is written."""
        values = {}
        for name, value in vars(self).items():
            if is_dataclass(value):
                values |= vars(value)
            elif name not in self.writes:
                values[name] = value
        return values

    def set_limits(self) -> None:
        """Bound what is read, and threads, also in worker processes; before OpenCV is loaded."""
        if self.limits:
            os.environ[VARIABLE] = self.limits
        for name in ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
            os.environ[name] = str(cores())
        os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(bounds().pixels))

    @property
    def log(self) -> TextIO:
        """Stream of lines that are printed during the work; stdout is for the JSON object."""
        return sys.stderr if self.json else sys.stdout

    def answer(self, record: object, *lines: str, then: Sequence[object] = ()) -> None:
        """Print a record as JSON; else lines, and the words of the command to run next."""
        if self.json:
            print_json(record)
            return
        for line in lines:
            say(line)
        if then:
            print_next("evercal", *then)

    def wait(self, record: object, words: str, line: str) -> None:
        """Print a record as JSON, or words and a line, and wait for SIGTERM or Ctrl-C."""
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt):
            self.answer(record, f"{words}; Ctrl-C ends it:", line)
            while True:
                time.sleep(1.0)  # Ctrl-C does not end a wait without end on Windows


@frozen
class Named:
    """Frames of the robot's software; their names go into exports."""

    base_frame: Name = None
    """The robot's base: a tf frame of a bag or a link of the URDF; elsewhere its name."""
    gripper_frame: Name = None
    """The gripper: a tf frame of a bag, a link of the URDF, or a feature or arm of a LeRobot
    dataset; elsewhere its name."""
    camera_frame: Name = None
    """Name of the camera's optical frame. Default: that of the images of a bag."""

    def names(self) -> FrameNames:
        """The names."""
        return FrameNames(*(name or "" for name in vars(self).values()))


HowNamed = Annotated[Named, arg(name="")]


@frozen
class Reading(Named):
    """How the recording is read; options that do not apply to its format are refused."""

    format: Name = None
    """Format of the recording: generic, 7scenes, 12scenes, cambridge, nerfstudio, colmap, wrist,
    lerobot or rosbag. Default: recognised from its files."""
    camera: File = None
    """Intrinsics of all images, if the recording has none: 3x3 matrix as text, JSON, YAML,
    NPZ, ROS camera_info or OpenCV's storage."""
    image_topic: Topic = None
    """Images of a bag or a LeRobot dataset; required if there are several topics."""
    pose_topic: Topic = None
    """tf or joint states of a bag; required if there are several topics."""
    urdf: File = None
    """URDF of the robot, for recordings with joint angles."""
    joint_map: File = None
    """File that says which column each joint of the URDF is, its sense, zero, unit and coupling;
    'evercal inspect' writes it."""
    pose_convention: Name = None
    """Format of the gripper poses, if the file's header does not state it; rad or deg for joint
    angles."""
    metres: bool = False
    """The poses of a COLMAP or nerfstudio recording are in metres. Default: their unit is unknown
    until 'evercal align'."""
    poses: Poses = "original"
    split: Annotated[str | None, shown("N:M")] = None
    """Test frames of a recording without any: 4:1 for one after every four training frames."""
    every: Number = 1
    """Use every N-th image."""

    def recording(
        self, path: Path, name: str | None = None, **how: bool
    ) -> "Recording":
        """Read the recording; `how` are further fields of `ReadOptions`."""
        from evercal.recordings import ReadOptions, load_recording

        options: dict[str, Any] = {**vars(self), **how}
        format = options.pop("format")
        return load_recording(path, format, name, ReadOptions(**options))

    def words(self) -> list[str]:
        """The options that were given, as words of a command."""
        words = []
        for field in fields(self):
            value = getattr(self, field.name)
            if value == field.default:
                continue
            words.append(option(field.name))
            if value is not True:
                words.append(str(value))
        return words


HowRead = Annotated[Reading, arg(name="")]


@frozen
class ArmGiven:
    """The arm that moved the gripper; its joints make errors that all images share."""

    arm: Name = None
    """The robot, such as ur5e, panda or irb120, or the file of its URDF: its joints explain errors
    that the images share. Default: a usual arm."""
    arm_accuracy: Annotated[str | None, shown("0.2deg|1mm")] = None
    """Standard deviation of the joints' offsets, or of the gripper's position. Default: that of
    the arm's class, 0.06deg of industrial arms, 0.2deg of cobots, 1.1deg of hobby arms."""

    def errors(self) -> "ArmErrors":
        """What is known of the arm."""
        from evercal.robot.pose_errors import ArmErrors

        return ArmErrors.stated(self.arm, self.arm_accuracy)


WhichArm = Annotated[ArmGiven, arg(name="")]


def next_words(calibration: "Calibration", file: object) -> list[object]:
    """The words of a test of a calibration file; after one, of its export to ROS.

    The export has options for unknown names.
    """
    from evercal.calibration.export.request import unknown_frames

    if not calibration.verifications:
        points = ("--points", "FILE", "--picks", "FILE")
        return ["verify", file, "IMAGE...", "--pick", *points]
    words: list[object] = ["export", file, "--format", "easy_handeye2"]
    for name, role in unknown_frames(calibration).items():
        words += [option(name), role.upper()]
    return words


def option(field: str) -> str:
    """The option of a field."""
    return "--" + field.replace("_", "-")


def camera_for(file: Path | None, images: Sequence[Path]) -> "Camera | None":
    """The camera in the file of --camera, for the size of the first readable image."""
    from evercal.recordings.images import first_size

    if not file:
        return None
    return stated_camera(file, first_size(images))


def stated_camera(file: Path | None, size: "Size | None" = None) -> "Camera | None":
    """The camera in the file of --camera, for images of (width, height)."""
    from evercal.recordings.cameras.camera_file import read_camera

    if not file:
        return None
    return read_camera(file, size)


def transform_of(file: Path | None) -> "SE3 | None":
    """The transform in a file of --gripper-from-camera or --calibration."""
    if not file:
        return None
    from evercal.calibration.transform_file import read_transform

    return read_transform(file)


def strategy_of(store: Path) -> str | None:
    """The strategy that a store was made with; None if there is no store yet."""
    from evercal.storage import read_manifest
    from evercal.storage.stages import is_store

    if not is_store(store):
        return None
    return str(read_manifest(store)["strategy"])


def open_localizer(
    store: Path, device: str = "auto", scenes: "Strings" = ()
) -> "LearnedLocalizer":
    """The localizer of a map, or of a store of networks on a device."""
    if strategy_of(store) in (MAP, None):
        if device != "auto":
            raise InputError(
                f"--device {device}: a map needs no device; omit the option"
            )
        return open_map(store, scenes)
    from evercal.continual.localizer import open_networks

    return open_networks(store, device)


def open_map(store: Path, scenes: "Strings" = ()) -> "Localizer":
    """The localizer of some scenes of a map, or of all; a store of networks is refused."""
    strategy = strategy_of(store)
    if strategy not in (MAP, None):
        raise InputError(
            f"{store}: holds networks of strategy {strategy}, and this needs a map; learn the scene"
            " with the default strategy"
        )
    from evercal.localization.localizer import Localizer

    localizer = Localizer.open(store)
    return localizer.within(scenes) if scenes else localizer


class Point(NamedTuple):
    """A point in the camera frame, metres."""

    x: float
    y: float
    z: float

    @classmethod
    def parse(cls, text: str | None, option: str = "--at") -> "Point | None":
        """The point of an option; None if it was omitted."""
        if text is None:
            return None
        try:
            point = cls(*map(float, text.split(",")))
        except (ValueError, TypeError):
            point = cls(math.nan, math.nan, math.nan)
        if not all(map(math.isfinite, point)):
            raise InputError(
                f"{option} {text}: give x,y,z in metres such as 0,0.05,0.4"
            )
        return point

    def record(self, parent_from_camera: "UncertainPose") -> dict[str, object]:
        """The point in both frames and its standard deviation per axis."""
        return {
            "point_m": list(self),
            "in_parent_m": parent_from_camera.pose.apply(self).tolist(),
            "sigma_mm": parent_from_camera.point_sigma_mm(self),
        }

    def text(self, parent_from_camera: "UncertainPose") -> str:
        """The standard deviation of the point in words."""
        sigma = parent_from_camera.point_sigma_mm(self)
        where = f"({self.x:g}, {self.y:g}, {self.z:g}) m in the camera frame"
        return f"{sigma:.2f} mm at {where}"
