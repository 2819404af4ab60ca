"""`evercal solve`."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from evercal.choices import MountName
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.calibrate import rig_lines, show_calibration
from evercal.cli.console import motion, require_writable, say_notes
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration, Rig
    from evercal.calibration.fixed.sightings import Sightings

_BY_IMAGE = ("camera_from_board", "leave_one_out_mm", "information_percent")
"""Checks with one value for each image."""


@frozen
class Known:
    """What is known in the base, for a fixed camera without motions of the robot."""

    board_at: Annotated[str | None, args.shown("FILE|X,Y,Z,QW,QX,QY,QZ")] = None
    """base_from_board of a board that stands still: a 4x4 matrix as text, or seven numbers;
    metres."""
    board_accuracy: Annotated[str, args.shown("MM,DEG")] = "1,0.2"
    """Standard deviations of this place per axis."""
    points: args.File = None
    """Points in the base: lines of name, x, y, z that the tool touched, metres."""
    picks: args.File = None
    """These points in images of the camera: lines of image, name, u, v in pixels."""
    camera: args.File = None
    """Intrinsics for --picks."""
    camera_points: args.File = None
    """Or these points in the camera frame, as a depth camera measures them, like --points."""
    touch_mm: Annotated[float, args.shown("MM")] = 0.5
    """Standard deviation per axis of a touched point."""
    pick_px: Annotated[float, args.shown("PX")] = 1.0
    """Standard deviation of a pick."""


@frozen
class Solve(args.Verb):
    """Calibrate a camera by pairs of poses, or by places in the base.

    Both unknown transforms are estimated jointly, robust to outliers, with their uncertainty. A
    fixed camera needs no motions where it sees a board at a known place (--board-at), or points
    that the robot knows (--points). Several fixed cameras that see one moving board are
    calibrated beside each other (several --camera-poses, no --robot-poses).

    Example: evercal solve --robot-poses poses.csv --camera-poses board.json --mount eye_in_hand
    """

    writes = ("out",)
    robot_poses: args.File = None
    """base_from_gripper of every image: a pose table, JSON, NPY or NPZ."""
    camera_poses: Annotated[tuple[Path, ...], args.shown("FILE...")] = ()
    """camera_from_board of every image: from 'evercal detect', or like --robot-poses. One file for
    each camera, named after it."""
    mount: Annotated[MountName | None, args.shown("eye_in_hand|eye_to_hand")] = None
    """eye_in_hand: camera on the gripper. eye_to_hand: fixed camera, board in the gripper. Required
    with --robot-poses."""
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
    known: Annotated[Known, arg(name="")] = field(default_factory=Known)
    which: args.WhichArm = field(default_factory=args.ArmGiven)
    frames: args.HowNamed = field(default_factory=args.Named)
    out: args.OutFile = Path("calibration.json")
    """Calibration file to write; of several cameras a file of all."""

    def run(self) -> int:
        require_writable(self.out, "--out")
        cameras = self._cameras()
        if len(cameras) > 1:
            from evercal.calibration.calibration import rig_of

            return self._write_rig(rig_of(cameras))
        if not cameras and not self.robot_poses:
            from evercal.calibration.fixed.rig import solve_rig

            return self._write_rig(solve_rig(self._sightings()))
        source = {"command": "solve"}
        calibration = next(iter(cameras.values()), None) or self._solved()
        names = self.frames.names()
        calibration = replace(calibration, source=source, frames=names)
        if not cameras:
            calibration = self._with_image_paths(calibration)
        calibration.write(self.out)
        lines = _check_lines(calibration)
        return show_calibration(self, calibration, self.out, lines=lines)

    def _cameras(self) -> "Mapping[str, Calibration]":
        """Fixed cameras by what is known in the base; empty where motions are needed."""
        known = self.known
        given = [self.robot_poses, known.board_at, known.points]
        if given.count(None) < 2:
            raise InputError(
                "--robot-poses, --board-at and --points are three ways; give one of them"
            )
        if known.points:
            return {"": self._by_points(known.points)}
        if known.board_at:
            from evercal.calibration.fixed.still import solve_place
            from evercal.calibration.transform_file import read_place
            from evercal.geometry import UncertainPose

            place = UncertainPose(*read_place(known.board_at, known.board_accuracy))
            seen = self._sightings()
            return {camera.name: solve_place(camera, place) for camera in seen}
        if not self.camera_poses:
            raise InputError("give --camera-poses, or --points of a fixed camera")
        if not self.robot_poses:
            return {}
        if len(self.camera_poses) > 1:
            raise InputError(
                "--camera-poses: with --robot-poses one camera at a time; give one file"
            )
        if not self.mount:
            raise InputError(
                "--mount: give eye_in_hand for a camera on the gripper, or eye_to_hand for a fixed"
                " camera"
            )
        from evercal.calibration.picked_points import read_positions

        tables = (self.robot_poses, *self.camera_poses)
        plain = [f for f in tables if read_positions(f) is not None]
        if not plain:
            return {}
        if len(plain) == 1 or self.mount == "eye_in_hand":
            raise InputError(
                f"{plain[0]}: positions without rotations; poses of both need them. Only points"
                " that a fixed camera sees at the robot's own point go without: positions of both"
                " and --mount eye_to_hand"
            )
        return {"": self._paired(*plain)}

    def _by_points(self, file: Path) -> "Calibration":
        known = self.known
        if known.camera_points:
            return self._paired(file, known.camera_points)
        if not known.picks or not known.camera:
            raise InputError(
                "--points: give --picks of them with the intrinsics (--camera), or --camera-points"
            )
        from evercal.calibration.fixed.touched_picks import solve_picks
        from evercal.calibration.picked_points import read_picks, read_points
        from evercal.recordings.cameras.camera_file import read_camera
        from evercal.recordings.images import first_size

        picks = read_picks(known.picks)
        size = first_size([known.picks.parent / pick.image for pick in picks])
        camera = read_camera(known.camera, size)
        points = read_points(file)
        return solve_picks(points, picks, camera, known.touch_mm / 1000, known.pick_px)

    def _paired(self, robot: Path, camera: Path) -> "Calibration":
        from evercal.calibration.fixed.point_pairs import solve_points
        from evercal.calibration.picked_points import paired_positions

        return solve_points(*paired_positions(robot, camera))

    def _sightings(self) -> "list[Sightings]":
        from evercal.calibration.fixed.sightings import read_sightings

        if self.mount == "eye_in_hand":
            raise InputError(
                "--mount eye_in_hand: a camera on the gripper needs --robot-poses"
            )
        inverted = self.invert in ("camera", "both")
        return read_sightings(self.camera_poses, self.camera_convention, inverted)

    def _write_rig(self, rig: "Rig") -> int:
        rig.write(self.out)
        first, *_ = rig.cameras
        then = ("export", f"{self.out}:{first}", "--format", "easy_handeye2")
        self.answer(rig.to_dict(), *rig_lines(rig), then=then)
        return 0

    def _solved(self) -> "Calibration":
        from evercal.calibration.pose_pairs.pair_files import (
            PairFiles,
            read_pairs,
            read_streams,
        )
        from evercal.calibration.pose_pairs.solve import solve
        from evercal.calibration.pose_pairs.time_offset import solve_with_offset

        assert self.robot_poses
        assert self.mount
        files = PairFiles(
            robot=self.robot_poses,
            camera=self.camera_poses[0],
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
        folder = self.camera_poses[0].absolute().parent
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
        board = moved(self.camera_poses[0].name)
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
