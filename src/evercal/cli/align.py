"""`evercal align`."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next
from evercal.cli.device import Device
from evercal.cli.image_words import image_files, read_images
from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.calibration.align import MapAlignment
    from evercal.localization.localizer import Localizer


@dataclass(frozen=True)
class Align:
    """Bring a scene that was learned in a frame of its own into the robot's base frame.

    Give images of a camera on the gripper with --robot-poses, or points that the tool has touched
    with --points and --picks. The error of the alignment is a part of every later answer.
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    """Name of the scene in the store."""
    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...")] = ()
    """Images of a camera on the gripper, or a folder of them."""
    robot_poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """The gripper's pose in the base at every image."""
    convention: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """How the numbers of the robot poses are meant, where the file does not say it."""
    board_poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """What 'evercal detect' found in the images, where the gripper holds a board and the camera
    stands anywhere in the scene."""
    points: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Touched points, base frame: lines of name, x, y, z in metres."""
    picks: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where the points are in images: lines of image, name, u, v in pixels."""
    unknown_scale: bool = False
    """The scene was not learned in metres: its scale is found too."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Aligns the scene and says how well."""
        by_points = self.points is not None or self.picks is not None
        if by_points == (self.robot_poses is not None):
            raise InputError(
                "give either images with --robot-poses, or --points with --picks, to say where the"
                " base is"
            )
        from evercal.features.device import device_of
        from evercal.localization.localizer import Localizer
        from evercal.mapping.store import Store

        where = device_of(self.device)
        opened = Store.open(self.store)
        with opened.writing():
            localizer = Localizer(opened.maps.to(where))
            found = self._by_points(localizer) if by_points else self._by_gripper(localizer)
            record = next(known for known in opened.maps.scenes if known.name == self.scene)
            placed = replace(
                record, alignment=found.alignment, frame_covariance=found.frame_covariance
            )
            opened.replace_record(self.scene, placed)
        self._tell(found)
        return 0

    def _by_gripper(self, localizer: "Localizer") -> "MapAlignment":
        from evercal.calibration.align import align_by_gripper
        from evercal.recordings.poses.pairing import poses_of_images

        files = image_files(self.images)
        assert self.robot_poses is not None
        poses = poses_of_images(self.robot_poses, files, self.convention)
        images, known, boards = read_images(files), not self.unknown_scale, None
        if self.board_poses is not None:
            from evercal.calibration.boards.board_poses import read_board_poses

            found = read_board_poses(self.board_poses).detected
            seen = {Path(image.name).name: image.camera_from_board for image in found}
            boards = {str(f): pose for f in files if (pose := seen.get(f.name)) is not None}
        return align_by_gripper(localizer, self.scene, images, poses, known, boards)

    def _by_points(self, localizer: "Localizer") -> "MapAlignment":
        from evercal.calibration.align import aligned_by_points
        from evercal.recordings import read_image

        if self.points is None or self.picks is None:
            raise InputError("--points and --picks belong together; give both")
        points = {name: at for (name,), at in _rows(self.points, 1, 3, "name, x, y, z")}
        by_image: dict[str, dict[str, np.ndarray]] = {}
        for (image, name), pixel in _rows(self.picks, 2, 2, "image, name, u, v"):
            if name not in points:
                raise InputError(f"{self.picks}: point {name!r} is not in {self.points}")
            by_image.setdefault(image, {})[name] = pixel
        folder = self.picks.parent
        picks = [(name, read_image(folder / name), seen) for name, seen in by_image.items()]
        return aligned_by_points(localizer, self.scene, points, picks, not self.unknown_scale)

    def _tell(self, found: "MapAlignment") -> None:
        place, (mm, deg) = found.alignment, found.sigma
        if self.json:
            gripper = found.gripper_from_camera
            print_json(
                {
                    "scene": self.scene,
                    "base_from_map": place.base_from_map.matrix().tolist(),
                    "scale": place.scale,
                    "sigma_mm": mm,
                    "sigma_deg": deg,
                    "used": found.used,
                    "given": found.of,
                    "gripper_from_camera": None if gripper is None else gripper.matrix().tolist(),
                }
            )
            return
        print(
            f"{self.scene} now answers in the robot's base frame, to {mm:.2f} mm and {deg:.3f} deg"
            f" (standard deviation per axis in the middle of the scene); scale {place.scale:.5f};"
            f" {found.used} of {found.of} agree within {found.residual}"
        )
        print_next("evercal", "calibrate", self.store, "IMAGE...")


def _rows(
    path: Path, names: int, numbers: int, columns: str
) -> "list[tuple[tuple[str, ...], np.ndarray]]":
    """Words and numbers of every line of a table; a header line is passed over.

    Raises:
        InputError: missing, or a line that does not hold the columns.
    """
    import csv

    import numpy as np

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    found = []
    for number, row in enumerate(csv.reader(text.splitlines(), skipinitialspace=True), start=1):
        if not row or row[0].startswith("#"):
            continue
        try:
            if len(row) != names + numbers:
                raise ValueError
            values = np.array([float(cell) for cell in row[names:]])
        except ValueError:
            if number == 1:
                continue
            got = ",".join(row)
            raise InputError(f"{path}:{number}: expected {columns}, got {got!r}") from None
        found.append((tuple(row[:names]), values))
    if not found:
        raise InputError(f"{path}: no rows in it; expected {columns}")
    return found
