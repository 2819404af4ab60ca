"""`evercal verify`."""

from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import require_writable, say_notes
from evercal.errors import InputError
from evercal.progress import progress_bar

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration
    from evercal.calibration.picked_points import PickedPoint
    from evercal.calibration.unseen.targets import Target
    from evercal.calibration.unseen.touched import Touches
    from evercal.geometry import SE3

_LINES = """\
{0.sentence}
  factor       true errors are {0.factor[1]:.1f} times the stated ones ({0.factor[0]:.1f} to\
 {0.factor[2]:.1f})
  d2           {0.d2:.1f} (6 or less is expected)"""
"""Text of a `Verification`."""
_DEPTH = (
    "  depth        {0.bias_mm:+.1f} mm and {0.scale:.4f} +- {0.scale_sigma:.4f} times the distance"
    " ({0.depths} depths)"
)
"""Text of a `DepthFit`."""


@frozen
class Verify(args.Verb):
    """Test a calibration with data that it has not seen; exit code 1 if it is not what it states.

    Give picks of touched points, a board or images of a mapped scene. A camera on the gripper, and
    a board or scene in the gripper, need the gripper poses of the images.

    Example: evercal verify tripod.json --points touched.csv --picks picks.csv
    """

    calibration: Annotated[Positional[Path], arg(metavar="CALIBRATION")]
    """Calibration file, or a map that was learned from gripper poses (MAP or MAP:SCENE)."""
    images: args.OptionalImages = ()
    """New images of a mapped scene, or a folder of them."""
    store: Annotated[Path | None, args.shown("MAP")] = None
    """Map of the scene that the images show."""
    scene: args.Scenes = ()
    board_poses: args.File = None
    """Board poses from 'evercal detect'."""
    target_pose: args.File = None
    """base_from_board, if it is known: a 4x4 matrix as text, metres."""
    picks: args.File = None
    """Touched points in images: lines of image, name, u, v in pixels; images relative to this
    file."""
    pick: bool = False
    """Pick the points in the images, on a page in the browser that writes the file of picks."""
    points: args.File = None
    """Touched points: lines of name, x, y, z of the tool's tip in the base frame, metres."""
    touches: args.File = None
    """Instead of points: gripper poses at the touches, with a column name. tip#2 is tip again."""
    tool: Annotated[str | None, args.shown("X,Y,Z")] = None
    """The tool's tip in the gripper frame, metres. Default: estimated from touches of one point in
    three orientations."""
    robot_poses: args.File = None
    """base_from_gripper of every image."""
    convention: args.Name = None
    """Format of the robot poses, if the file does not state it."""
    depth: args.Folder = None
    """Depth images, named like the images: whole numbers are millimetres, others metres."""
    touch_mm: Annotated[float, args.shown("MM")] = 0.5
    """Standard deviation per axis between the tool's tip and a touched point."""
    pick_px: Annotated[float, args.shown("PX")] = 1.0
    """Standard deviation of a pick."""
    which: args.WhichArm = field(default_factory=args.ArmGiven)

    def run(self) -> int:
        from evercal.calibration.learned import calibration_at
        from evercal.calibration.unseen.depth import depth_fit
        from evercal.calibration.unseen.targets import target_data
        from evercal.calibration.unseen.touched import touched_data

        calibration = calibration_at(self.calibration)
        camera = calibration.camera
        lines = []
        if self.picks:
            if self.pick:
                self._pick(self._touches(), self.picks)
            picks, grippers = self._picked(calibration, self.picks)
            touches = self._touches()
            data = touched_data(calibration, touches, picks, grippers, self.pick_px)
        else:
            target, grippers = self._target(calibration)
            pose = args.transform_of(self.target_pose)
            data = target_data(calibration, target, grippers, pose)
            if self.depth and camera:
                lines.append(_DEPTH.format(depth_fit(self.depth, camera, target)))
        errors = None
        if self.which != args.ArmGiven():
            errors = self.which.errors()
        found = calibration.verify(data, errors)
        known = (*calibration.verifications, found.to_dict())
        calibration = replace(calibration, verifications=known)
        if self.calibration.is_file():
            calibration.write(self.calibration)
        for name, miss_m in found.misses_m.items():
            lines.append(f"  {1000 * miss_m:8.2f} mm  {name}")
        if not found.agrees:
            for name, share in found.causes.items():
                lines.append(f"  cause        {name}: {100 * share:.0f} %")
        lines.insert(0, _LINES.format(found))
        then = ()
        if found.agrees:
            then = args.next_words(calibration, self.calibration)
        lines += filter(None, [found.advice])
        self.answer(found.to_dict(), *lines, then=then)
        return 0 if found.agrees else 1

    def _touches(self) -> "Touches":
        import numpy as np

        from evercal.calibration.picked_points import read_points
        from evercal.calibration.unseen.touched import Touches, touched_tips
        from evercal.recordings.poses.robot_poses import read_robot_poses

        sigma_m = self.touch_mm / 1000
        if self.points:
            return touched_tips(read_points(self.points), sigma_m)
        if not self.touches:
            raise InputError("--picks: give --points or --touches of these points")
        rows = read_robot_poses(self.touches, self.convention, option="`convention`")
        if rows.names is None:
            raise InputError(f"{self.touches}: add a column name of the touched points")
        tool = args.Point.parse(self.tool, "--tool")
        return Touches(rows.names, rows.poses, tool and np.array(tool), sigma_m)

    def _pick(self, touches: "Touches", out: Path) -> None:
        from evercal.recordings.image_files import image_files
        from evercal.service.picking import PickServer

        require_writable(out, "--picks")
        with PickServer(image_files(self.images), touches.points, out) as server:
            print(f"pick the points at {server.url}", file=self.log, flush=True)
            server.wait()

    def _grippers(self, images: "dict[str, Path]") -> "dict[str, SE3]":
        from evercal.recordings.poses.pairing import poses_of_images

        if not self.robot_poses:
            return {}
        files = [*images.values()]
        poses, notes = poses_of_images(self.robot_poses, files, self.convention)
        say_notes(notes)
        return dict(zip(images, poses, strict=True))

    def _picked(
        self, calibration: "Calibration", file: Path
    ) -> "tuple[list[PickedPoint], dict[str, SE3]]":
        from evercal.calibration.picked_points import read_picks
        from evercal.calibration.unseen.depth import depth_at, read_depth
        from evercal.recordings.images import first_size

        picks = read_picks(file)
        images = {pick.image: file.parent / pick.image for pick in picks}
        _require_size(calibration, first_size([*images.values()]))
        if self.depth and calibration.camera:
            for i, pick in enumerate(picks):
                depth = read_depth(self.depth, pick.image, calibration.camera)
                picks[i] = pick._replace(depth_m=depth_at(depth, pick.pixel))
        return picks, self._grippers(images)

    def _target(self, calibration: "Calibration") -> "tuple[Target, dict[str, SE3]]":
        from evercal.calibration.boards.board_poses import read_board_poses
        from evercal.calibration.drift import within_reference
        from evercal.calibration.located import locate
        from evercal.calibration.unseen.targets import board_target, scene_target
        from evercal.recordings.image_files import image_files

        if self.board_poses:
            boards = read_board_poses(self.board_poses)
            _require_size(calibration, boards.camera.size)
            target = board_target(boards)
            return target, self._grippers({name: Path(name) for name in target})
        if not self.store:
            raise InputError(
                "give --picks, --board-poses, or images with the --store that maps their scene"
            )
        files = image_files(self.images)
        localizer = args.open_map(self.store, self.scene)
        localizer = within_reference(localizer, calibration)
        named = [(str(file), file) for file in files]
        with progress_bar("localizing", len(files), "image") as bar:
            located = locate(localizer, named, calibration.camera, bar.update)
        return scene_target(located), self._grippers(dict(named))


def _require_size(calibration: "Calibration", size: tuple[int, int]) -> None:
    camera = calibration.camera
    if camera and camera.size != size:
        raise InputError(
            f"the images are {size[0]}x{size[1]}, those of the calibration"
            f" {camera.width}x{camera.height}; give images and calibration of one camera"
        )
