"""Where the studio keeps everything, and the command lines that do the same."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from evercal.calibration.export.formats import FORMATS
from evercal.service.studio.devices import Which


@dataclass(frozen=True)
class Folders:
    """Paths of the studio."""

    out: Path
    """Folder of recordings, calibrations and exports."""
    map: Path
    """Folder of the map."""

    @property
    def wrist(self) -> Path:
        """Recording of the camera on the gripper."""
        return self.out / "wrist"

    @property
    def fixed(self) -> Path:
        """Images of the fixed camera."""
        return self.out / "fixed"

    @property
    def fixed_camera(self) -> Path:
        """Intrinsics of the fixed camera, if they were given."""
        return self.out / "fixed_camera.json"

    @property
    def reachable(self) -> Path:
        """Gripper poses that the arm can reach, if they are known."""
        return self.out / "reachable.csv"

    @property
    def settings(self) -> Path:
        """What a restarted studio continues with."""
        return self.out / "studio.json"

    def calibration(self, which: Which) -> Path:
        """Calibration of a camera."""
        return self.out / f"{which}.json"

    def export(self, which: Which, format: str) -> Path:
        """File of an export; camera and format are in its name, as formats share endings."""
        # easy_handeye2 looks files up by their name.
        name = which if format == "easy_handeye2" else f"{which}_{format}"
        return self.out / "export" / f"{name}{FORMATS[format].ending}"

    def report(self, which: Which) -> Path:
        """Report about a calibration."""
        return self.out / f"{which}.html"

    def record_command(self) -> str:
        """Coverage and next views of the recording."""
        words: list[object] = ["inspect", self.wrist, "--coverage"]
        if self.reachable.is_file():
            words += ["--next", self.reachable]
        return line(*words)

    def learn_command(self, scene: str) -> str:
        """Learn the recording."""
        file = self.calibration("wrist")
        return line("learn", self.map, self.wrist, "--name", scene, "--calibration", file)

    def fixed_command(self) -> str:
        """Calibrate the fixed camera."""
        words: list[object] = ["calibrate", self.map, self.fixed, "--out"]
        words.append(self.calibration("fixed"))
        if self.fixed_camera.is_file():
            words += ["--camera", self.fixed_camera]
        return line(*words)

    def check_command(self) -> str:
        """Check whether the fixed camera has moved."""
        reference = self.calibration("fixed")
        return line("check", self.map, self.out / "check.jpg", "--reference", reference)

    def export_command(self, which: Which, format: str) -> str:
        """Export a calibration."""
        words: list[object] = ["export", self.calibration(which), "--format", format]
        words += ["--out", self.export(which, format)]
        if needs_robot_poses(which, format):
            words += ["--robot-poses", self.wrist / "base_from_gripper.csv"]
        return line(*words)

    def report_command(self, which: Which) -> str:
        """Write a report."""
        words: list[object] = ["report", self.calibration(which), "--store", self.map]
        if which == "wrist":
            words += ["--images", self.wrist / "images"]
        return line(*words, "--out", self.report(which))


def needs_robot_poses(which: Which, format: str) -> bool:
    """Whether an export states a pose for every image of the camera on the gripper."""
    return which == "wrist" and FORMATS[format].per_image


def line(*words: object) -> str:
    """A command of evercal, quoted for a shell."""
    return shlex.join(["evercal", *map(str, words)])
