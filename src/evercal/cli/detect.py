"""`evercal detect`."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.image_words import image_files
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.boards.board_poses import BoardPoses
    from evercal.calibration.boards.corners import BoardView
    from evercal.calibration.boards.detection import Board


@dataclass(frozen=True)
class Detect:
    """Find a printed board in images, and its pose in each; for 'evercal solve'.

    Without --camera the intrinsics are found from the board.
    """

    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
    """Image files of one camera, or a folder of them."""
    board: Literal["chessboard", "charuco", "apriltag"]
    """What is printed."""
    size: Annotated[str | None, arg(metavar="CxR", help_behavior_hint="")] = None
    """Inner corners of a chessboard (9x6), or squares of a ChArUco board."""
    square_mm: Annotated[float | None, arg(metavar="MM", help_behavior_hint="")] = None
    """Side of a square, or of the black square of a tag."""
    marker_mm: Annotated[float, arg(metavar="MM", help_behavior_hint="")] = 0.0
    """Side of a marker of a ChArUco board."""
    dictionary: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Of the markers or tags, OpenCV's name without DICT_: 4X4_50, APRILTAG_36h11."""
    tag: Annotated[int | None, arg(metavar="ID", help_behavior_hint="")] = None
    """Number of the tag; any when left out."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of the intrinsics; found from the board when left out."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("board.json")
    """Where the poses and corners are written."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Looks at every image and writes what was found."""
        board, files = self._board(), image_files(self.images)
        from evercal.calibration.boards.board_poses import board_poses
        from evercal.calibration.boards.detection import find_board
        from evercal.calibration.boards.intrinsics import calibrate_camera
        from evercal.recordings import image_size, read_image
        from evercal.recordings.poses.camera_file import read_camera

        names = [path.name for path in files]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"{twice[0]}: two images of this name; give every image its own name")
        width, height = image_size(files[0])
        views: dict[str, BoardView | str] = {}
        with progress_bar("detecting", len(files), "image") as bar:
            for path in files:
                image = read_image(path)
                if image.shape[:2] != (height, width):
                    raise InputError(
                        f"{path}: is {image.shape[1]}x{image.shape[0]}, the first image"
                        f" {width}x{height}; give images of one camera"
                    )
                views[path.name] = find_board(image, board)
                bar.update()
        seen = [view for view in views.values() if not isinstance(view, str)]
        if not seen:
            first = next(iter(views.items()))
            raise InputError(f"no board in any of {len(files)} images ({first[0]}: {first[1]})")
        if self.camera is not None:
            lens = read_camera(self.camera, (width, height))
            if (lens.width, lens.height) != (width, height):
                raise InputError(
                    f"{self.camera}: is for images of {lens.width}x{lens.height}, these are"
                    f" {width}x{height}; give the intrinsics of this image size"
                )
            found = board_poses(board, lens, views)
        else:
            found_lens = calibrate_camera(seen, width, height)
            found = board_poses(board, found_lens.camera, views, "board")
        found.write(self.out)
        self._tell(found)
        return 0

    def _board(self) -> "Board":
        from evercal.calibration.boards.detection import Board

        if self.square_mm is None:
            raise InputError("--square-mm: give the side of a square, or of the tag, millimetres")
        match = re.fullmatch(r"(\d+)x(\d+)", self.size or "0x0")
        if match is None:
            raise InputError(f"--size {self.size}: give two numbers such as 9x6")
        usual = {"chessboard": "", "charuco": "4X4_50", "apriltag": "APRILTAG_36h11"}
        return Board(
            self.board,
            self.square_mm / 1000,
            int(match[1]),
            int(match[2]),
            self.marker_mm / 1000,
            self.dictionary or usual[self.board],
            self.tag,
        )

    def _tell(self, found: "BoardPoses") -> None:
        if self.json:
            print_json(found.to_dict())
            return
        for image in found.images:
            if image.camera_from_board is None:
                print(f"{image.name}: {image.reason}")
                continue
            x, y, z = 1000 * image.camera_from_board.translation_m
            print(f"{image.name}: board at {x:+.1f} {y:+.1f} {z:+.1f} mm, {image.rms_px:.2f} px")
        lens = found.camera
        print(
            f"{len(found.found)} of {len(found.images)} images show the board; corners are good to"
            f" {found.corner_sigma_px:.2f} px; camera (from the {found.camera_from}) fx"
            f" {lens.fx:.2f}, fy {lens.fy:.2f}, cx {lens.cx:.2f}, cy {lens.cy:.2f}"
        )
        words = ("--robot-poses", "FILE", "--camera-poses", self.out, "--mount", "eye_in_hand")
        print_next("evercal", "solve", *words)
