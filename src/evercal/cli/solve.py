"""`evercal solve`."""

import os
from collections.abc import Iterator
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from evercal.choices import MountName
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.calibrate import show_calibration
from evercal.cli.console import motion, require_writable, say_notes

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration

_BY_IMAGE = ("camera_from_board", "leave_one_out_mm", "information_percent")
"""Checks with one value for each image."""


@frozen
class Solve(args.Verb):
    """Calibrate a camera on or beside the robot from pairs of poses.

    Both unknown transforms are estimated jointly, robust to outliers, with their uncertainty.

    Example: evercal solve --robot-poses poses.csv --camera-poses board.json --mount eye_in_hand
    """

    writes = ("out",)
    robot_poses: args.InFile
    """base_from_gripper of every image: a pose table, JSON, NPY or NPZ."""
    camera_poses: args.InFile
    """camera_from_board of every image: from 'evercal detect', or like --robot-poses."""
    mount: MountName
    """eye_in_hand: camera on the gripper. eye_to_hand: fixed camera, board in the gripper."""
    scale: Literal["known", "unknown"] = "known"
    """unknown: estimate the scale of the camera poses, for structure from motion."""
    time_offset: bool = False
    """Estimate the offset between the clocks of robot and camera; both files need times."""
    robot_convention: args.Name = None
    """Pose convention of robot poses without a header: ur, kuka, xyzw:mm, ..."""
    camera_convention: args.Name = None
    """Pose convention of camera poses without a header."""
    invert: Annotated[
        Literal["robot", "camera", "both"] | None, args.shown("robot|camera|both")
    ] = None
    """Invert the poses of a file: robot, camera or both."""
    which: args.WhichArm = field(default_factory=args.ArmGiven)
    frames: args.HowNamed = field(default_factory=args.Named)
    out: args.OutFile = Path("calibration.json")
    """Calibration file to write."""

    def run(self) -> int:
        require_writable(self.out, "--out")
        source = {"command": "solve"}
        solved = replace(self._solved(), source=source, frames=self.frames.names())
        calibration = self._with_image_paths(solved)
        calibration.write(self.out)
        lines = _check_lines(calibration)
        return show_calibration(self, calibration, self.out, lines=lines)

    def _solved(self) -> "Calibration":
        from evercal.calibration.pose_pairs.pair_files import (
            PairFiles,
            read_pairs,
            read_streams,
        )
        from evercal.calibration.pose_pairs.solve import solve
        from evercal.calibration.pose_pairs.time_offset import solve_with_offset

        files = PairFiles(
            robot=self.robot_poses,
            camera=self.camera_poses,
            robot_convention=self.robot_convention,
            camera_convention=self.camera_convention,
            invert=self.invert,
        )
        scale_known = self.scale == "known"
        if self.time_offset:
            return solve_with_offset(*read_streams(files), self.mount, scale_known)
        pairs, corners = read_pairs(files)
        errors = self.which.errors()
        solved = solve(pairs, self.mount, scale_known, corners, errors)
        say_notes(pairs.notes)  # a refusal is one line
        return solved

    def _with_image_paths(self, calibration: "Calibration") -> "Calibration":
        """Make image paths relative to the calibration, where `evercal report` looks them up."""
        folder = self.camera_poses.absolute().parent
        target = self.out.absolute().parent

        def moved(name: str) -> str:
            path = folder / name
            if not path.is_file():
                return name
            return Path(os.path.relpath(path, target)).as_posix()

        images = [
            replace(image, name=moved(image.name)) for image in calibration.images
        ]
        by_image = {}
        for key in _BY_IMAGE:
            values = getattr(calibration.checks, key) or {}
            by_image[key] = {moved(name): value for name, value in values.items()}
        checks = replace(calibration.checks, **by_image)
        board = moved(self.camera_poses.name)
        source = {**calibration.source, "camera_poses": board}
        return replace(calibration, images=tuple(images), checks=checks, source=source)


def _check_lines(calibration: "Calibration") -> Iterator[str]:
    checks = calibration.checks
    camera = calibration.camera
    residual = motion(checks.residual_mm, checks.residual_deg)
    yield f"  residuals    {residual} (root mean square)"
    if checks.corner_sigma_px is not None:
        yield f"  corners      {checks.corner_sigma_px:.2f} px (standard deviation)"
    if checks.corners_left_out:
        where = ", ".join(checks.corners_left_out)
        yield f"  left out     corners that leave their neighbours (image x y): {where}"
    if checks.scale is not None:
        scale = f"{checks.scale:.6g} +- {checks.scale_sigma:.2g}"
        yield f"  scale        {scale} (size of the board, or metres per unit)"
    if camera and checks.camera_sigma is not None:
        sigma = checks.camera_sigma
        focal = f"fx {camera.fx:.2f}, fy {camera.fy:.2f} +- {sigma['fx']:.2f} px"
        centre = f"cx {camera.cx:.2f}, cy {camera.cy:.2f} +- {sigma['cx']:.2f} px"
        yield f"  intrinsics   {focal}, {centre}"
    if checks.time_offset_s is not None:
        offset = 1000 * checks.time_offset_s
        spread = 1000 * (checks.time_offset_sigma_s or 0.0)
        yield f"  clocks       robot time = camera time {offset:+.1f} +- {spread:.1f} ms"
    yield from map("  left open    {}".format, checks.left_open or ())
    yield from map("warning: {}".format, checks.warnings or ())
