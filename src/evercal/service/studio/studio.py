"""`Studio`: everything that the page can do, without the page.

Samples, images and results are written when they are made. A studio that is opened on the same
folder continues with them.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.live.coverage import CoverageOptions
from evercal.live.recorder import pose_rows
from evercal.live.robot import MovingRobot
from evercal.map import Map
from evercal.service.studio import results
from evercal.service.studio.book import Proposal, SampleBook
from evercal.service.studio.devices import Connection, Devices, Which
from evercal.service.studio.fixed import FixedCamera, option_of_studio, shift_words
from evercal.service.studio.folders import Folders
from evercal.service.studio.steps import Facts, StepState, step_states
from evercal.service.studio.wrist import LearnedSamples, OnStep, learn_mount, read_learned
from evercal.storage import write_bytes

FIXED_IMAGES = 8
"""Images of a series of the fixed camera."""
_MOST_REFUSED = 20
"""Proposed poses in a row that the arm may refuse."""


class Studio:
    """The state of the way to a calibration.

    Args:
        devices: cameras and robot.
        folders: where everything is kept.
        device: `auto`, `cpu` or `cuda`, for the map.

    Raises:
        InputError: The folder holds another recording, or something that cannot be read.
    """

    def __init__(self, devices: Devices, folders: Folders, device: str = "auto"):
        self.connection, self.folders = Connection(devices), folders
        folders.out.mkdir(parents=True, exist_ok=True)
        self.cell = Map.open(folders.map, device=device)
        self.book = SampleBook(folders.wrist, devices)
        self.fixed = FixedCamera(folders, devices.fixed_intrinsics)
        self.learned = read_learned(folders.settings)
        self.calibrations: dict[Which, Calibration] = {}
        if devices.reachable is not None:
            write_bytes(folders.reachable, pose_rows(devices.reachable).encode())
        for which in ("wrist", "fixed"):
            self._read(which)

    @property
    def devices(self) -> Devices:
        """Cameras and robot."""
        return self.connection.devices

    @property
    def gripper_from_camera(self) -> SE3 | None:
        """The mount, calibrated or rough."""
        found = self.calibrations.get("wrist")
        return self.devices.rough if found is None else found.parent_from_child

    @property
    def scene(self) -> str:
        """Name of the scene that the recording is learned as."""
        return self.folders.wrist.name if self.learned is None else self.learned.scene

    def facts(self) -> Facts:
        """What the steps depend on."""
        seen = self.connection.seen
        verdicts = {which: found.verdict for which, found in self.calibrations.items()}
        learned = self.learned
        return Facts(
            connected=seen.complete,
            connection_problem=seen.camera_problem or seen.robot_problem,
            coverage=self.book.coverage(self.gripper_from_camera),
            mount_verdict=verdicts.get("wrist"),
            samples_changed=learned is None or set(learned.samples) != set(self.book.names),
            scenes=len(self.cell.scenes),
            has_fixed=self.devices.fixed_camera is not None,
            fixed_images=len(self.fixed.files),
            fixed_verdict=option_of_studio(verdicts.get("fixed")),
            exported=len(list((self.folders.out / "export").glob("*"))),
        )

    def steps(self) -> tuple[StepState, ...]:
        """All steps in order."""
        return step_states(self.facts())

    def take_sample(self) -> str:
        """Record image and pose; returns what was done, as all of the following methods.

        Raises:
            InputError: No image or pose, or the arm moves.
        """
        frame = self.book.add(*self.connection.sample())
        row = self.book.coverage().samples[-1]
        problems = f", {'; '.join(row.problems)}: better remove it" if row.problems else ""
        return f"Took sample {frame.name}{problems}."

    def remove(self, *names: str) -> str:
        """Remove samples."""
        for name in names:
            self.book.remove(name)
        return f"Removed {', '.join(names)}." if names else "There is no bad sample."

    def proposal(self) -> Proposal | None:
        """The next best view."""
        return self.book.proposal(self.gripper_from_camera)

    def move_to(self, base_from_gripper: SE3) -> str:
        """Move the arm.

        Raises:
            InputError: The pose is out of reach, or this robot does not move on request.
        """
        robot = self.devices.robot
        if not isinstance(robot, MovingRobot):
            raise InputError("this robot does not move on request; move it by hand")
        try:
            robot.move_to(base_from_gripper)
        except InputError:
            self.book.refuse(base_from_gripper)
            raise
        time.sleep(self.devices.settle_s)
        self.connection.look(None)
        return "The arm is there."

    def record(self, on_step: OnStep, stopping: Callable[[], bool] = lambda: False) -> str:
        """Move from one best view to the next and take samples until nothing is missing."""
        refused, wanted = 0, CoverageOptions().images
        if not self.book.frames:
            self.take_sample()
        while not stopping():
            covered, proposal = self.book.coverage(self.gripper_from_camera), self.proposal()
            good = sum(not row.problems for row in covered.samples)
            if not covered.missing or proposal is None or good >= 2 * wanted:
                break
            on_step(f"recording, {good} good images", min(good, wanted), wanted)
            try:
                self.move_to(proposal.base_from_gripper)
            except InputError:
                refused += 1
                if refused > _MOST_REFUSED:
                    raise
                continue
            refused = 0
            self.take_sample()
        return f"{len(self.book.frames)} samples are recorded."

    def learn(self, on_step: OnStep) -> str:
        """Learn the recording and calibrate the camera on the gripper.

        Raises:
            InputError: The recording cannot be used.
        """
        names = self.book.names
        found, scene = learn_mount(self.cell, self.folders, self.learned, on_step)
        self.learned = LearnedSamples(scene, names)
        self.learned.write(self.folders.settings)
        self.calibrations["wrist"] = found
        return f"Learned {len(names)} images; wrote {self.folders.calibration('wrist')}."

    def take_fixed(self) -> str:
        """Take an image of the fixed camera.

        Raises:
            InputError: There is no fixed camera, or no image.
        """
        return f"Took image {self.fixed.add(self.connection.image('fixed')).name}."

    def take_fixed_series(self, on_step: OnStep, move: bool) -> str:
        """Take several images; the arm may go to poses of samples, so that it hides other parts."""
        poses = list(self.book.poses) if move else []
        for i in range(FIXED_IMAGES):
            on_step("taking images", i, FIXED_IMAGES)
            if poses:
                self.move_to(poses[i * len(poses) // FIXED_IMAGES])
            self.take_fixed()
        return f"Took {FIXED_IMAGES} images."

    def calibrate_fixed(self, on_step: OnStep) -> str:
        """Calibrate the fixed camera.

        Raises:
            InputError: No image, or none was located.
        """
        total, done = len(self.fixed.files), iter(range(1, len(self.fixed.files) + 1))
        on_step("locating images", 0, total)
        found = self.fixed.calibrate(
            self.cell, lambda: on_step("locating images", next(done, total), total)
        )
        self.calibrations["fixed"] = found
        return f"Calibrated the fixed camera; wrote {self.folders.calibration('fixed')}."

    def check_fixed(self) -> str:
        """Test with a new image whether the fixed camera has moved.

        Raises:
            InputError: It is not calibrated, or the image was not located.
        """
        reference, image = self.calibration("fixed"), self.connection.image("fixed")
        return shift_words(self.fixed.check(self.cell, image, reference))

    def calibration(self, which: Which) -> Calibration:
        """A calibration that was made.

        Raises:
            InputError: There is none.
        """
        if which not in self.calibrations:
            raise InputError(f"the {which} camera is not calibrated yet")
        return self.calibrations[which]

    def export(self, which: Which, format: str) -> str:
        """Export a calibration in a format of `evercal export`.

        Raises:
            InputError: The format needs something that the studio does not have.
        """
        files = results.export(self.folders, which, self.calibration(which), format)
        return f"Wrote {', '.join(map(str, files))}."

    def report(self, which: Which) -> str:
        """Write the HTML report of a calibration."""
        localizer: Any = self.cell.localizer if self.cell.scenes else None
        path = results.report(self.folders, which, self.calibration(which), localizer)
        return f"Wrote {path}."

    def _read(self, which: Which) -> None:
        """Continue with a calibration of an earlier session whose scene is in the map."""
        path: Path = self.folders.calibration(which)
        if path.is_file():
            found = read_calibration(path)
            if found.source.get("scene") in self.cell.scenes:
                self.calibrations[which] = found
