"""`evercal detect`."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from evercal.choices import BoardKind, CameraModel
from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import numbers, require_writable
from evercal.errors import InputError
from evercal.progress import progress_bar

if TYPE_CHECKING:
    from evercal.calibration.boards.board import Board
    from evercal.calibration.boards.board_poses import BoardPoses
    from evercal.calibration.boards.detection import Found, Image
    from evercal.calibration.boards.tag_layout import Arrangement
    from evercal.geometry import Camera
    from evercal.typing import Size, Strings

_DICTIONARIES: dict[BoardKind, str] = {
    "chessboard": "",
    "charuco": "4X4_50",
    "apriltag": "APRILTAG_36h11",
    "aprilgrid": "APRILTAG_36h11",
    "arucogrid": "4X4_50",
    "circles": "",
    "acircles": "",
}
"""Dictionaries of markers by default."""


@frozen
class Detect(args.Verb):
    """Detect a printed board in images and estimate its pose in each.

    The poses are for 'evercal solve'. Without --camera the intrinsics are estimated from the board.

    Example: evercal detect images/ --board chessboard --size 9x6 --square-mm 25
    """

    board: BoardKind
    """Printed board; aprilgrid: Kalibr's, arucogrid: OpenCV's GridBoard, acircles: rows shifted."""
    images: args.OptionalImages = ()
    """Image files of one camera, or a folder of them."""
    size: Annotated[str | None, args.shown("CxR")] = None
    """Inner corners of a chessboard (9x6), squares of a ChArUco board, markers or circles."""
    square_mm: Annotated[float | None, args.shown("MM")] = None
    """Side of a square, or of the black square of a tag or marker; from row to row of circles."""
    marker_mm: Annotated[float, args.shown("MM")] = 0.0
    """Side of a marker of a ChArUco board, or diameter of a circle of --make-board, millimetres."""
    gap_mm: Annotated[float, args.shown("MM")] = 0.0
    """Distance between two markers of a grid, millimetres."""
    dictionary: Annotated[
        str | None,
        args.shown("NAME", "(default: 4X4_50, APRILTAG_36h11 for tags and aprilgrid)"),
    ] = None
    """Dictionary of markers or tags, OpenCV's name without DICT_."""
    tag: Annotated[int | None, args.shown("ID", "(default: any)")] = None
    """Number of the tag, or of the first marker of a grid."""
    layout: Annotated[str | None, args.shown("FILE|estimate")] = None
    """Tags of several numbers as one board: a file of where they lie, or by the images."""
    camera: args.File = None
    """File of the intrinsics; if omitted, they are estimated from the board."""
    lens: CameraModel = "pinhole"
    """Model of the estimated intrinsics: fisheye for wide lenses, from about 110 degrees."""
    out: args.OutFile = Path("board.json")
    """File of poses and corners to write."""
    make_board: Annotated[Path | None, args.shown("FILE.pdf|png")] = None
    """Write the board at true size, to print; detect nothing."""
    paper: Annotated[str, arg(metavar="NAME")] = "a4"
    """Paper of --make-board: a4, letter, a3, tabloid, a2, a1 or a0."""

    def run(self) -> int:
        if self.make_board:
            return self._make(self.make_board)
        if not self.images:
            raise InputError(
                "no images: give image files or a folder, or --make-board FILE.pdf"
            )
        require_writable(self.out, "--out")
        from evercal.recordings.image_files import image_files
        from evercal.storage.text_files import refuse_repeated

        board = self._board()
        files = image_files(self.images)
        try:
            names = [path.name for path in files]
            refuse_repeated(names, "give each image a unique name")
        except ValueError as error:
            raise InputError(str(error)) from None
        from evercal.calibration.boards.board_poses import board_poses
        from evercal.calibration.boards.corners import BoardView
        from evercal.calibration.boards.intrinsics import calibrate_camera
        from evercal.calibration.boards.stated_lens import compared_lens
        from evercal.recordings.cameras.camera_file import read_camera_of_size
        from evercal.recordings.images import first_size

        width, height = first_size(files)
        camera = None
        source = "file"
        if self.camera:
            camera = read_camera_of_size(
                self.camera, (width, height), "the first image"
            )
        arrange = None
        if self.layout:
            arrange = self._arrangement(board, (width, height), camera)
        board, views, notes = self._detected(files, board, width, height, arrange)
        detected = [view for view in views.values() if isinstance(view, BoardView)]
        if not camera:
            camera = calibrate_camera(detected, width, height, self.lens).camera
            source = "board"
        poses = board_poses(board, camera, views, source)
        warning = ""
        if source == "file":
            poses, warning = compared_lens(poses)
        poses.write(self.out)
        solve = ("solve", "--robot-poses", "FILE", "--camera-poses", self.out)
        then = (*solve, "--mount", "MOUNT")
        self.answer(poses.to_dict(), *_lines(poses, notes, warning), then=then)
        return 0

    def _make(self, path: Path) -> int:
        from evercal.calibration.boards.printing import label, write_board

        if self.images:
            raise InputError("--make-board: give no images; it detects nothing")
        require_writable(path, "--make-board")
        board = self._board()
        write_board(path, board, self.paper)
        self.answer(
            {"file": str(path), "paper": self.paper, "board": board.to_dict()},
            f"wrote {path} on {self.paper}: {label(board)} Measure the 100 mm ruler.",
        )
        return 0

    def _board(self) -> "Board":
        from evercal.calibration.boards.board import Board

        if self.square_mm is None:
            raise InputError(
                "--square-mm: give the side of a square, or of the tag, millimetres"
            )
        dictionary = self.dictionary or _DICTIONARIES[self.board]
        match = re.fullmatch(r"(\d+)[xX,](\d+)", self.size or "0x0")
        if not match:
            raise InputError(f"--size {self.size}: give two numbers such as 9x6")
        return Board(
            kind=self.board,
            size_m=self.square_mm / 1000,
            columns=int(match[1]),
            rows=int(match[2]),
            marker_m=self.marker_mm / 1000,
            gap_m=self.gap_mm / 1000,
            dictionary=dictionary.removeprefix("DICT_"),
            tag=self.tag,
        )

    def _arrangement(
        self, board: "Board", size: "Size", camera: "Camera | None"
    ) -> "Arrangement":
        from evercal.calibration.boards.tag_layout import Arrangement

        if self.board != "apriltag":
            raise InputError(
                "--layout: give --board apriltag, for markers of any dictionary"
            )
        file = Path(self.layout or "")
        if self.layout == "estimate":
            file = None
        return Arrangement(board, size, camera, file)

    def _detected(
        self,
        files: Sequence[Path],
        board: "Board",
        width: int,
        height: int,
        arrange: "Arrangement | None",
    ) -> "Found":
        from evercal.calibration.boards.detection import find_boards
        from evercal.recordings import read_image

        folder = self.out.absolute().parent
        by_name = {
            Path(os.path.relpath(file.absolute(), folder)).as_posix(): file
            for file in files
        }
        with progress_bar("detecting", len(files), "image") as bar:

            def read(name: str) -> "Image | str":
                bar.update()
                file = by_name[name]
                try:
                    image = read_image(file)
                except InputError as error:
                    return str(error).removeprefix(f"{file}: ")
                if image.shape[:2] != (height, width):
                    raise InputError(
                        f"{file}: is {image.shape[1]}x{image.shape[0]}, the first image"
                        f" {width}x{height}; give images of one camera"
                    )
                return image

            return find_boards(list(by_name), read, board, arrange)


def _lines(poses: "BoardPoses", notes: "Strings", warning: str) -> Iterator[str]:
    for image in poses.images:
        if not image.camera_from_board:
            yield f"{image.name}: {image.reason}"
            continue
        position = numbers(1000 * image.camera_from_board.translation_m, "+.1f")
        yield f"{image.name}: board at {position} mm, {image.rms_px:.2f} px"
        if image.left_out:
            corners = ", ".join(numbers(corner, ".0f") for corner in image.left_out)
            yield f"{image.name}: left out what leaves its neighbours, corners at x y {corners}"
    camera = poses.camera
    yield (
        f"{len(poses.detected)} of {len(poses.images)} images show the board; corner noise"
        f" {poses.corner_sigma_px:.2f} px; camera (from the {poses.camera_from})"
        f" fx {camera.fx:.2f}, fy {camera.fy:.2f}, cx {camera.cx:.2f}, cy {camera.cy:.2f}"
    )
    yield from notes
    if warning:
        yield f"warning: {warning}"
