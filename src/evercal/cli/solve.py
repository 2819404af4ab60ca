"""`evercal solve`."""

import json as json_lines
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from evercal.cli.calibrate import calibration_lines
from evercal.cli.console import print_json, print_next
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.calibration.pairs import PosePairs
    from evercal.calibration.solve import BoardCorners


@dataclass(frozen=True)
class Solve:
    """Solve for a camera on the gripper, or beside the robot, from pairs of poses.

    A X = X B and A X = Z B, found together, robust against wrong poses, with their uncertainty.
    """

    robot_poses: Annotated[Path, arg(metavar="FILE")]
    """base_from_gripper of every image: CSV, JSON, NPY or TUM."""
    camera_poses: Annotated[Path, arg(metavar="FILE")]
    """camera_from_board of every image: what 'evercal detect' wrote, or a file like the robot
    poses."""
    mount: Literal["eye_in_hand", "eye_to_hand"]
    """eye_in_hand: the gripper carries the camera. eye_to_hand: the camera stands still and the
    gripper holds the board."""
    convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """How the numbers of the robot poses are meant, where the file does not say it."""
    unknown_scale: bool = False
    """The camera's translations are not in metres (structure from motion): find their scale."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("calibration.json")
    """Where the calibration is written."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Solves, writes the file and says what it is good for."""
        from evercal.calibration.solve import solve
        from evercal.calibration.verdict import tier

        pairs, corners = self._pairs()
        found = solve(pairs, self.mount, not self.unknown_scale, corners)
        found = replace(found, source={"command": "solve", "mount": self.mount})
        found.write(self.out)
        if self.json:
            print_json(found.to_dict())
        else:
            for line in [*calibration_lines(found), *_check_lines(found)]:
                print(line)
            print_next("evercal", "export", self.out, "--format", "easy_handeye2")
        return 0 if tier(found) else 1

    def _pairs(self) -> "tuple[PosePairs, BoardCorners | None]":
        """Robot and camera poses that belong together; rows pair by name, else in order."""
        from evercal.calibration.board_poses import FORMAT, read_board_poses
        from evercal.calibration.pairs import PosePairs
        from evercal.datasets.robot_poses import read_robot_poses
        from evercal.geometry import SE3

        robot = read_robot_poses(self.robot_poses, self.convention)
        if _is_of_format(self.camera_poses, FORMAT):
            board = read_board_poses(self.camera_poses)
            names = [image.name for image in board.images]
            rows = self._rows(names, robot.names, len(robot))
            seen = [i for i, image in enumerate(board.images) if image.camera_from_board]
            poses = [board.images[i].camera_from_board for i in seen]
            chosen = [rows[i] for i in seen]
            pairs = PosePairs(
                tuple(names[i] for i in seen),
                robot.poses[chosen],
                SE3.stack([pose for pose in poses if pose is not None]),
            )
            from evercal.calibration.solve import BoardCorners

            views = [board.images[i].view for i in seen]
            corners = BoardCorners(
                board.camera,
                tuple(view for view in views if view is not None),
                board.board.half_turn,
            )
            return pairs, corners
        camera = read_robot_poses(self.camera_poses, self.convention)
        names = list(camera.names or (f"row {i + 1}" for i in range(len(camera))))
        rows = self._rows(names if camera.names else [], robot.names, len(robot), len(camera))
        return PosePairs(tuple(names), robot.poses[rows], camera.poses), None

    def _rows(
        self,
        names: list[str],
        robot_names: "tuple[str, ...] | None",
        count: int,
        wanted: int | None = None,
    ) -> list[int]:
        """Row of the robot poses for every camera pose."""
        wanted = len(names) if wanted is None else wanted
        if robot_names is not None and names:
            where = {Path(name).stem: i for i, name in enumerate(robot_names)}
            missing = [name for name in names if Path(name).stem not in where]
            if missing:
                raise InputError(
                    f"{self.robot_poses}: has no row for {missing[0]}; its first row is for"
                    f" {robot_names[0]}"
                )
            return [where[Path(name).stem] for name in names]
        if count != wanted:
            raise InputError(
                f"{self.robot_poses}: {count} poses for {wanted} of {self.camera_poses}; give as"
                " many, in one order, or name the images in both files"
            )
        return list(range(wanted))


def _is_of_format(path: Path, format: str) -> bool:
    try:
        data = json_lines.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(data, dict) and data.get("format") == format


def _check_lines(found: "Calibration") -> list[str]:
    checks, lines = found.checks, []
    if "held_out_mm" in checks:
        lines.append(
            f"  left out     poses are predicted within {checks['held_out_mm']:.2f} mm and"
            f" {checks['held_out_deg']:.3f} deg"
        )
    if "residual_mm" in checks:
        lines.append(
            f"  residuals    {checks['residual_mm']:.2f} mm, {checks['residual_deg']:.3f} deg root"
            " mean square"
        )
    if "scale" in checks:
        lines.append(f"  scale        {checks['scale']:.5f} +- {checks['scale_sigma']:.5f}")
    return lines
