"""`evercal solve`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from evercal.cli.calibrate import calibration_lines
from evercal.cli.console import print_json, print_next

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration


@dataclass(frozen=True)
class Solve:
    """Find a camera on the gripper, or beside the robot, from pairs of poses.

    Both unknown transforms are found together, robust against wrong poses, with their uncertainty.
    """

    robot_poses: Annotated[Path, arg(metavar="FILE")]
    """base_from_gripper of every image: CSV, JSON, NPY or TUM."""
    camera_poses: Annotated[Path, arg(metavar="FILE")]
    """camera_from_board of every image: what 'evercal detect' wrote, or a file like the robot
    poses."""
    mount: Literal["eye_in_hand", "eye_to_hand"]
    """eye_in_hand: the gripper carries the camera. eye_to_hand: the camera stands still and the
    gripper holds the board."""
    scale: Literal["known", "unknown"] = "known"
    """unknown: the camera's translations are not in metres (structure from motion)."""
    time_offset: bool = False
    """The clocks of robot and camera differ: find by how much. Both files need times."""
    robot_convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """How the numbers of the robot poses are meant, where the file does not say it."""
    camera_convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The same of the camera poses."""
    invert: Annotated[
        Literal["robot", "camera", "both"] | None, arg(metavar="WHOSE", help_behavior_hint="")
    ] = None
    """Poses that their file holds inverted (gripper_from_base, board_from_camera): robot, camera or
    both."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("calibration.json")
    """Where the calibration is written."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Solves, writes the file and says what it is good for."""
        from evercal.calibration.verdict import tier

        source = {
            "command": "solve",
            "robot_poses": str(self.robot_poses),
            "camera_poses": str(self.camera_poses),
            "mount": self.mount,
            "scale": self.scale,
            "time_offset": self.time_offset,
            "robot_convention": self.robot_convention,
            "camera_convention": self.camera_convention,
            "invert": self.invert,
        }
        found = replace(self._solved(), source=source)
        found.write(self.out)
        if self.json:
            print_json(found.to_dict())
        else:
            for line in [*calibration_lines(found), *_check_lines(found)]:
                print(line)
            print_next("evercal", "export", self.out, "--format", "easy_handeye2")
        return 0 if tier(found) else 1

    def _solved(self) -> "Calibration":
        from evercal.calibration.pose_pairs.pair_files import PairFiles, read_pairs, read_streams
        from evercal.calibration.pose_pairs.solve import solve
        from evercal.calibration.pose_pairs.time_offset import solve_with_offset

        files = PairFiles(
            self.robot_poses,
            self.camera_poses,
            self.robot_convention,
            self.camera_convention,
            self.invert,
        )
        scale_known = self.scale == "known"
        if self.time_offset:
            return solve_with_offset(*read_streams(files), self.mount, scale_known)
        pairs, corners = read_pairs(files)
        return solve(pairs, self.mount, scale_known, corners)


def _check_lines(found: "Calibration") -> list[str]:
    checks, lines = found.checks, []
    if "held_out_mm" in checks:
        lines.append(
            f"  left out     half of the poses are predicted within {checks['held_out_mm']:.2f} mm"
            f" and {checks['held_out_deg']:.3f} deg"
        )
    lines.append(
        f"  residuals    {checks['residual_mm']:.2f} mm, {checks['residual_deg']:.3f} deg (root"
        f" mean square)"
    )
    if "corner_sigma_px" in checks:
        lines.append(f"  corners      {checks['corner_sigma_px']:.2f} px (standard deviation)")
    if "scale" in checks:
        scale, sigma = checks["scale"], checks["scale_sigma"]
        lines.append(f"  scale        {scale:.6g} +- {sigma:.2g} metres per unit of the camera")
    if "time_offset_s" in checks:
        offset, sigma = 1000 * checks["time_offset_s"], 1000 * checks["time_offset_sigma_s"]
        lines.append(
            f"  clocks       add {offset:+.1f} +- {sigma:.1f} ms to the camera's times to get the"
            f" robot's"
        )
    return [*lines, *(f"warning: {sentence}" for sentence in checks.get("warnings", ()))]
