"""`evercal align`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import motion
from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.calibration.from_map.align import MapAlignment


@frozen
class Align(args.Verb):
    """Transform a scene in a frame of its own to the base frame.

    Give images of a camera on the gripper with --robot-poses, points that the tool has touched with
    --points and --picks, or --board-poses of a board that stands still. The error of the alignment
    is part of every later answer.

    Example: evercal align cell.evercal cell wrist/ --robot-poses poses.csv
    """

    store: args.Store
    scene: args.SceneName
    """Name of the scene."""
    images: args.OptionalImages = ()
    """Images of a camera on the gripper, or a folder of them."""
    robot_poses: args.File = None
    """base_from_gripper of every image."""
    convention: args.Name = None
    """Format of the robot poses, if the file does not state it."""
    board_poses: args.File = None
    """Board poses from 'evercal detect'. With --robot-poses, the gripper holds the board before a
    fixed camera. Without them it stands still, and other images show it."""
    board_at: Annotated[str | None, args.shown("FILE|X,Y,Z,QW,QX,QY,QZ")] = None
    """base_from_board of a board that stands still; metres. Default: the board is the base."""
    board_accuracy: Annotated[str, args.shown("MM,DEG")] = "1,0.2"
    """Standard deviations of --board-at per axis."""
    points: args.File = None
    """Touched points in the base frame: lines of name, x, y, z in metres."""
    picks: args.File = None
    """Points in images: lines of image, name, u, v in pixels; images relative to this file."""
    distance: Annotated[tuple[str, ...], args.shown("A,B=METRES")] = ()
    """Metres between two picked points, such as A,B=0.297, in place of --points: the scene keeps
    its own frame."""
    base_frame: args.Frame = None
    """Name of the base frame, which goes into exports."""
    unknown_scale: bool = False
    """Estimate the scale, for a scene that was not learned in metres. Default where the unit of
    length of its recording is unknown."""

    def run(self) -> int:
        by_points = self.points is not None or self.picks is not None
        by_board = self.board_poses is not None and self.robot_poses is None
        if by_points + by_board + (self.robot_poses is not None) != 1:
            raise InputError(
                "give either images with --robot-poses, --points or --distance with --picks, or"
                " --board-poses of a board that stands still"
            )
        if not self.robot_poses and (self.images or self.convention):
            raise InputError(
                "images and --convention belong to --robot-poses; omit them"
            )
        if self.board_at and not by_board:
            raise InputError(
                "--board-at: give --board-poses, too, and no --robot-poses"
            )
        from evercal.map import Map
        from evercal.mapping.store import MapStore

        cell = Map(MapStore.open(self.store))
        unit = cell.localizer.contents.scene(self.scene).unit or 1.0
        given = self._given(by_board)
        alignment = cell.align(
            self.scene,
            **given,
            unknown_scale=self.unknown_scale,
            base_frame=self.base_frame,
        )
        self._show(alignment, unit)
        return 0

    def _given(self, by_board: bool) -> dict[str, Any]:
        """What `Map.align` takes."""
        if by_board:
            return self._by_board()
        if self.robot_poses:
            return self._by_gripper()
        return self._by_points()

    def _by_gripper(self) -> dict[str, Any]:
        """What `Map.align` takes of images with gripper poses."""
        from evercal.calibration.boards.board_poses import read_board_poses
        from evercal.recordings.image_files import image_files

        files = image_files(self.images)
        boards = None
        if self.board_poses:
            images = read_board_poses(self.board_poses).detected
            poses = {Path(i.name).name: i.camera_from_board for i in images}
            boards = {}
            for file in files:
                pose = poses.get(file.name)
                if pose:
                    boards[str(file)] = pose
        return {
            "images": files,
            "robot_poses": self.robot_poses,
            "convention": self.convention,
            "boards": boards,
        }

    def _by_board(self) -> dict[str, Any]:
        """What it takes of a board that stands still."""
        from evercal.calibration.transform_file import read_place
        from evercal.geometry import UncertainPose

        place = None
        if self.board_at:
            place = UncertainPose(*read_place(self.board_at, self.board_accuracy))
        return {"board_poses": self.board_poses, "board_at": place}

    def _by_points(self) -> dict[str, Any]:
        """What it takes of points."""
        from evercal.calibration.picked_points import read_picks, read_points
        from evercal.recordings import read_image

        if not self.picks or bool(self.points) == bool(self.distance):
            raise InputError("give --picks with either --points or --distance")
        points = None
        if self.points:
            points = read_points(self.points)
        by_image: dict[str, dict[str, np.ndarray]] = {}
        for image, name, pixel, _ in read_picks(self.picks):
            if points is not None and name not in points:
                raise InputError(
                    f"{self.picks}: point {name!r} is not in {self.points}"
                )
            by_image.setdefault(image, {})[name] = pixel
        folder = self.picks.parent
        picks = [(name, read_image(folder / name), p) for name, p in by_image.items()]
        distances = dict(map(_distance, self.distance))
        return {"points": points, "picks": picks, "distances": distances}

    def _show(self, alignment: "MapAlignment", unit: float) -> None:
        """Print it; `unit` is that of the recording, per unit of the map."""
        from evercal.storage.text_files import few

        similarity = alignment.similarity
        mm, deg = alignment.sigma
        scale = similarity.scale / unit  # metres per unit of the recording
        mount = alignment.gripper_from_camera
        lines = list(map("warning: {}".format, alignment.warnings))
        if alignment.left_out:
            lines.insert(0, f"  left out     {few(alignment.left_out, most=8)}")
        self.answer(
            {
                "scene": self.scene,
                "base_from_map": similarity.base_from_map.matrix().tolist(),
                "scale": scale,
                "sigma_mm": mm,
                "sigma_deg": deg,
                "used": alignment.used,
                "given": alignment.given,
                "gripper_from_camera": mount and mount.matrix().tolist(),
                "warnings": alignment.warnings,
                "left_out": alignment.left_out,
            },
            f"aligned {self.scene}: standard deviation {motion(mm, deg, ' and ')} per axis in"
            f" the middle of the scene; scale {scale:.5f}; {alignment.used} of"
            f" {alignment.given} are inliers, residual {alignment.residual}",
            *lines,
            then=("calibrate", self.store, "IMAGE..."),
        )


def _distance(text: str) -> tuple[tuple[str, str], float]:
    """The names and metres of A,B=0.297."""
    ends, _, metres = text.partition("=")
    first, _, second = ends.partition(",")
    try:
        return (first, second), float(metres)
    except ValueError:
        raise InputError(
            f"--distance {text}: give two picked points and metres, such as A,B=0.297"
        ) from None
