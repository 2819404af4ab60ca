"""`evercal export`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.calibration.export.request import Content, Export


@dataclass(frozen=True)
class ExportCalibration:
    """Write a calibration as a file of another program; `--format list` shows all formats.

    Without `--out` it is printed. A calibration is parent_from_child: the camera in the robot's
    base if it stands still (eye_to_hand), in the gripper if the arm carries it (eye_in_hand).
    """

    calibration: Annotated[
        Positional[Path | None], arg(metavar="CALIBRATION.json", help_behavior_hint="")
    ] = None
    """File of the calibration."""
    format: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """easy_handeye2, static_transform_publisher, launch_py, urdf, opencv, csv, json, colmap, kuka,
    ...; `list` shows all of them with a line each."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where it goes; a folder for colmap."""
    parent: Annotated[str | None, arg(metavar="FRAME", help_behavior_hint="")] = None
    """Name of the parent frame: the robot's base, or its gripper."""
    child: Annotated[str | None, arg(metavar="FRAME", help_behavior_hint="")] = None
    """Name of the child frame: the camera's optical frame."""
    via: Annotated[str | None, arg(metavar="FRAME", help_behavior_hint="")] = None
    """Root frame of the camera's driver, such as camera_link: the pose of that frame is written,
    which fits into a tf tree where the driver has already put the optical frame."""
    via_transform: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where the optical frame lies in the driver's root frame: what
    `ros2 topic echo --once /tf_static` prints, or a TransformStamped as YAML."""
    via_offset: Annotated[
        tuple[float, float, float] | None, arg(metavar="X Y Z", help_behavior_hint="")
    ] = None
    """In place of the file: origin of the optical frame in the driver's root frame in metres
    (forward, left, up); the axes are those of ROS (x forward, z up)."""
    via_optical: bool = False
    """In place of the file: both frames share their origin."""
    robot_frame: Annotated[str | None, arg(metavar="FRAME", help_behavior_hint="")] = None
    """The robot's other frame, which easy_handeye names too: that of the gripper for a fixed
    camera, of the base for a camera on the arm."""
    robot_poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Poses of the gripper in the base, image by image: for tum, colmap and nerfstudio of a camera
    on the arm, and for moveit_samples."""
    target_poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Poses of the board in the camera, image by image, for moveit_samples; their file says how
    they are meant."""
    convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """How the robot poses are meant where their file does not say it: ur, kuka, fanuc, wxyz, ..."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Reads everything before it writes anything."""
        from evercal.calibration.export.formats import (
            FORMATS,
            TF_FORMATS,
            format_name,
            write_content,
        )

        if self.format is None or self.format == "list":
            return self._list()
        name = format_name(self.format)
        if self.calibration is None:
            raise InputError("no calibration given; name its JSON file behind 'export'")
        export = self._export(self.calibration)
        content = FORMATS[name].write(export)
        if name in TF_FORMATS and self.via is None and "optical" in export.child:
            print(
                f"note: camera drivers publish {export.child} themselves; if yours does, name its"
                f" root frame with --via, or the frame has two parents in tf",
                file=sys.stderr,
            )
        if self.out is None and not isinstance(content, str):
            what = "a folder" if isinstance(content, dict) else "not text"
            raise InputError(f"{name} is {what} and cannot be printed; give --out")
        files = [] if self.out is None else write_content(self.out, content)
        if self.json:
            print_json(self._record(export, content, files))
        elif self.out is None:
            sys.stdout.write(str(content))
        else:
            print(f"wrote {', '.join(map(str, files))}")
            print(f"  {export.calibration.meaning}")
            if export.calibration.verdict:
                print(f"  {export.calibration.verdict}")
            print_next("evercal", "check", "STORE", "IMAGE", "--reference", self.calibration)
        return 0

    def _list(self) -> int:
        from evercal.calibration.export.formats import FORMATS

        if self.format is None and self.calibration is not None:
            raise InputError(f"no format given; add --format NAME, one of {', '.join(FORMATS)}")
        if self.json:
            print_json({"formats": {name: form.description for name, form in FORMATS.items()}})
            return 0
        for name, form in FORMATS.items():
            print(f"{name:27} {form.description}")
        print_next("evercal", "export", self.calibration or "CALIBRATION.json", "--format", "NAME")
        return 0

    def _export(self, path: Path) -> "Export":
        from evercal.calibration.calibration import read_calibration
        from evercal.calibration.export.request import Export, renamed
        from evercal.recordings.poses.robot_poses import read_robot_poses

        calibration = renamed(read_calibration(path), self.parent, self.child)
        robot, target = (
            None if file is None else read_robot_poses(file, convention, option=option)
            for file, convention, option in (
                (self.robot_poses, self.convention, "--convention"),
                (self.target_poses, None, None),
            )
        )
        return Export(
            self._via(calibration),
            # A shell's ~/cell.calib is filed under cell.
            "evercal" if self.out is None else self.out.name.split(".")[0] or "evercal",
            self.robot_frame,
            robot,
            target,
            optical=self.via is None,
        )

    def _via(self, calibration: "Calibration") -> "Calibration":
        ways = [self.via_transform is not None, self.via_offset is not None, self.via_optical]
        if self.via is None:
            if any(ways):
                raise InputError("name the driver's root frame with --via, such as camera_link")
            return calibration
        if sum(ways) != 1:
            raise InputError(
                f"--via {self.via} needs to know where the optical frame lies in it; give one of"
                f" --via-transform FILE, --via-offset X Y Z, or --via-optical if their origins are"
                f" the same"
            )
        from evercal.calibration.export.driver_frame import (
            published_at,
            read_link_from_optical,
            standard_link_from_optical,
        )

        if self.via_transform is not None:
            found = read_link_from_optical(self.via_transform, self.via, calibration.child_frame)
        else:
            found = standard_link_from_optical(self.via_offset or (0.0, 0.0, 0.0))
        return published_at(calibration, self.via, found)

    def _record(self, export: "Export", content: "Content", files: list[Path]) -> dict[str, object]:
        return {
            "format": self.format,
            "mount": export.calibration.mount,
            "parent_frame": export.parent,
            "child_frame": export.child,
            "meaning": export.calibration.meaning,
            "translation_m": export.pose.translation_m.tolist(),
            "quaternion_wxyz": export.pose.rotation_wxyz.tolist(),
            "verdict": export.calibration.verdict,
            "files": [str(file) for file in files],
            "text": content if isinstance(content, str) and not files else None,
        }
