"""`Studio`: everything that the page can do, without the page."""

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.export.formats import FORMATS, export_files
from evercal.calibration.next_views import NextViews, looked_at, next_views
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.live.coverage import IMAGES, Coverage, Sample, coverage
from evercal.live.recorder import JPEG_QUALITY, POSES, WristRecorder
from evercal.live.robot import MovingRobot
from evercal.map import Map
from evercal.recordings.images import write_jpeg
from evercal.recordings.poses.camera_file import read_camera
from evercal.service.studio.devices import Connection, Devices, Which
from evercal.storage import sha256_file, write_json

FIXED_IMAGES = 8
"""Images of a series of the fixed camera."""
_CANDIDATES = 200
_TURN_RAD, _ROLL_RAD, _NEARER = np.deg2rad(30.0), np.deg2rad(40.0), 0.25
"""How far proposed views may lie from recorded ones where reachable poses are unknown."""
_TABLE = "robot_poses_sha256"
"""Entry of a calibration's source: checksum of the samples' table of poses."""

_measured = cache(Sample.of)

State = tuple[Literal["waits", "to do", "done"], str]
"""Status of a step, and what was found or what to do in one to three sentences."""

OnStep = Callable[[str, float, float], Any]


class Studio:
    """The way to a calibration, in a folder that a later studio continues with.

    Actions return what was done, in one line, and raise `InputError` if it cannot be done.
    """

    def __init__(self, devices: Devices, out: Path, map: Path | None = None):
        self.connection, self.out = Connection(devices), out
        out.mkdir(parents=True, exist_ok=True)
        self.cell = Map.open(map or out / "map")
        self.recorder = WristRecorder(out / "wrist", devices.intrinsics)
        self.mount = devices.rough
        """gripper_from_camera, rough or calibrated; None if nothing is known."""
        self.watched: Callable[[], bool] = lambda: True
        """Whether somebody sees what the arm does; it moves only then."""
        self._refused: list[SE3] = []
        self._fixed_camera = out / "fixed_camera.json"
        if devices.fixed_intrinsics is not None:
            write_json(self._fixed_camera, asdict(devices.fixed_intrinsics))
        self.calibrations: dict[Which, Calibration] = {}
        for which in ("wrist", "fixed"):
            path = self.calibration_file(which)
            found = read_calibration(path) if path.is_file() else None
            if found is not None and found.source.get("scene") in self.cell.scenes:
                self._keep(which, found)

    def calibration_file(self, which: Which) -> Path:
        """Calibration of a camera."""
        return self.out / f"{which}.json"

    @property
    def can_move(self) -> bool:
        """Whether the arm moves on request."""
        return isinstance(self.connection.devices.robot, MovingRobot)

    @property
    def scene(self) -> str | None:
        """The scene that was learned from the recording; None before."""
        found = self.calibrations.get("wrist")
        return None if found is None else str(found.source["scene"])

    @property
    def samples_changed(self) -> bool:
        """Whether samples were added or removed since they were learned."""
        found, table = self.calibrations.get("wrist"), self._table_sha256()
        return found is None or table is None or found.source.get(_TABLE) != table

    def _table_sha256(self) -> str | None:
        table = self.out / "wrist" / POSES
        return sha256_file(table) if table.is_file() else None

    @property
    def fixed_images(self) -> list[Path]:
        """Images of the fixed camera, in order."""
        return sorted((self.out / "fixed").glob("*.jpg"))

    def coverage(self) -> Coverage:
        """What the samples cover."""
        return coverage([_measured(frame) for frame in self.recorder.frames], self.mount)

    def bad_samples(self) -> list[str]:
        """Names of the samples with problems."""
        return [row.name for row in self.coverage().samples if row.problems]

    def next_view(self) -> NextViews | None:
        """The view that would lower the uncertainty most; None before the first good sample.

        It is one of the reachable poses, else one near those of the samples.
        """
        rows = self.coverage().samples
        poses = [_measured(frame).base_from_gripper for frame in self.recorder.frames]
        good = [pose for pose, row in zip(poses, rows, strict=True) if not row.problems]
        if not good:
            return None
        reachable = self.connection.devices.reachable
        if reachable is None:
            reachable = _around(SE3.stack(poses), SE3.stack(good), self.mount)
        excluded = SE3.stack([*poses, *self._refused])
        views = next_views(SE3.stack(good), reachable, 1, self.mount, excluded)
        return views if len(views.poses) else None

    def take_sample(self) -> str:
        """Record image and pose."""
        name = self.recorder.add(*self.connection.sample()).name
        bad = "; ".join(self.coverage().samples[-1].problems)
        return f"Took sample {name}{f', {bad}: better remove it' if bad else ''}."

    def remove(self, *names: str) -> str:
        """Remove samples."""
        for name in names:
            self.recorder.remove(name)
        return f"Removed {', '.join(names)}." if names else "There is no bad sample."

    def move_to(self, base_from_gripper: SE3) -> str:
        """Move the arm."""
        robot = self.connection.devices.robot
        if not isinstance(robot, MovingRobot):
            raise InputError("this robot does not move on request; move it by hand")
        self._require_watched()
        try:
            robot.move_to(base_from_gripper)
        except InputError:
            self._refused.append(base_from_gripper)
            raise
        time.sleep(self.connection.devices.settle_s)
        self.connection.look(None)
        return "The arm is there."

    def record(self, on_step: OnStep, stopping: Callable[[], bool] = lambda: False) -> str:
        """Move from one best view to the next and take samples until nothing is missing."""
        if not self.recorder.frames:
            self.take_sample()
        while not stopping():
            reached, view = self.coverage(), self.next_view()
            good = sum(not row.problems for row in reached.samples)
            if not reached.missing or view is None or good >= 2 * IMAGES:
                break
            on_step(f"recording, {good} good images", min(good, IMAGES), IMAGES)
            self._require_watched()
            try:
                self.move_to(view.poses[0])
            except InputError:  # out of reach, and never proposed again
                continue
            self.take_sample()
        return f"{len(self.recorder.frames)} samples are recorded."

    def learn(self, on_step: OnStep) -> str:
        """Learn the recording and calibrate the camera on the gripper.

        The scene that the studio learned before is replaced once the new one is in the map.
        """
        old, cell, path = self.scene, self.cell, self.calibration_file("wrist")
        table = self._table_sha256()
        scene = _free_name("wrist", cell.scenes)
        report = cell.learn(self.out / "wrist", name=scene, on_progress=on_step)
        if old is not None:
            cell.remove(old)
            cell.rename(scene, old)
            scene = old
        assert report.hand_eye is not None, "the recording states gripper poses"
        scenes = cell.localizer.contents.scenes
        camera = next(found.adjusted_camera for found in scenes if found.name == scene)
        calibration = report.hand_eye.calibration(camera, scene, report.train_frames)
        calibration = replace(calibration, source={**calibration.source, _TABLE: table})
        calibration.write(path)
        self._keep("wrist", calibration)
        return f"Learned {report.train_frames} images; wrote {path}."

    def take_fixed(self) -> str:
        """Take an image of the fixed camera."""
        image, folder = self.connection.image("fixed"), self.out / "fixed"
        folder.mkdir(exist_ok=True)
        number = max((int(path.stem) for path in self.fixed_images), default=-1) + 1
        write_jpeg(folder / f"{number:04d}.jpg", image, JPEG_QUALITY)
        return f"Took image {number:04d}.jpg."

    def take_fixed_series(self, on_step: OnStep, move: bool) -> str:
        """Take several images; the arm may go to poses of samples, so that it hides other parts."""
        poses = [frame.base_from_gripper for frame in self.recorder.frames] if move else []
        for i in range(FIXED_IMAGES):
            on_step("taking images", i, FIXED_IMAGES)
            pose = poses[i * len(poses) // FIXED_IMAGES] if poses else None
            if pose is not None:
                self.move_to(pose)
            self.take_fixed()
        return f"Took {FIXED_IMAGES} images."

    def clear_fixed(self) -> str:
        """Remove all images of the fixed camera, such as after it was moved."""
        for path in self.fixed_images:
            path.unlink()
        return "Removed all images."

    def calibrate_fixed(self, on_step: OnStep) -> str:
        """Calibrate the fixed camera."""
        files, given = self.fixed_images, self._fixed_camera
        if not files:
            raise InputError("no image of the fixed camera yet; take one first")
        on_step("locating images", 0, len(files))
        found = self.cell.calibrate(
            files,
            camera=read_camera(given) if given.is_file() else None,
            mount="eye_to_hand",
        )
        found = replace(found, source={**found.source, "store": str(self.cell.path)})
        found.write(self.calibration_file("fixed"))
        self._keep("fixed", found)
        return f"Calibrated the fixed camera; wrote {self.calibration_file('fixed')}."

    def check_fixed(self) -> str:
        """Test with a new image whether the fixed camera has moved."""
        reference, image = self._made("fixed"), self.connection.image("fixed")
        shift = self.cell.check([image], reference)
        size = f"{shift.translation_mm:.2f} mm and {shift.rotation_deg:.3f} deg"
        if not shift.moved:
            return f"The camera has not moved: it is within {size} of its calibration."
        sure = f"{100 * shift.confidence:.1f} %"
        return f"The camera has moved by {size} (confidence {sure}). Calibrate it again."

    def export(self, which: Which, format: str) -> str:
        """Export a calibration in a format of `evercal export`."""
        calibration, folder = self._made(which), self.out / "export"
        folder.mkdir(exist_ok=True)
        # Formats share endings; easy_handeye2 looks files up by their name.
        name = which if format == "easy_handeye2" else f"{which}_{format}"
        options: dict[str, Any] = {}
        if which == "wrist" and FORMATS[format].per_image:
            options["robot_poses"] = self.out / "wrist" / POSES
        path = folder / f"{name}{FORMATS[format].ending}"
        files = export_files(calibration, format, path, **options).files
        return f"Wrote {', '.join(map(str, files))}."

    def _require_watched(self) -> None:
        if not self.watched():
            raise InputError("the arm moves only while a browser shows the studio; open its page")

    def _made(self, which: Which) -> Calibration:
        if which not in self.calibrations:
            raise InputError(f"the {which} camera is not calibrated yet")
        return self.calibrations[which]

    def _keep(self, which: Which, calibration: Calibration) -> None:
        self.calibrations[which] = calibration
        if which == "wrist":
            self.mount = calibration.parent_from_child


def _around(recorded: SE3, good: SE3, gripper_from_camera: SE3 | None) -> SE3:
    """Poses (n,) near recorded ones that look at the same point."""
    mount = SE3.identity() if gripper_from_camera is None else gripper_from_camera
    point_m = looked_at(good @ mount)
    rng, cameras = np.random.default_rng(len(recorded)), recorded @ mount
    start = cameras[rng.integers(len(cameras), size=_CANDIDATES)]
    turns, closer = np.zeros((2, _CANDIDATES, 6))
    turns[:, 3:] = rng.uniform(-_TURN_RAD, _TURN_RAD, (_CANDIDATES, 3))
    distance = np.linalg.norm(start.translation_m - point_m, axis=1)
    closer[:, 2] = distance * rng.uniform(-_NEARER, _NEARER, _CANDIDATES)
    closer[:, 5] = rng.uniform(-_ROLL_RAD, _ROLL_RAD, _CANDIDATES)
    there, back = SE3.from_translation(point_m), SE3.from_translation(-point_m)
    return there @ SE3.exp(turns) @ back @ start @ SE3.exp(closer) @ mount.inverse()


def _free_name(name: str, taken: tuple[str, ...]) -> str:
    numbered = (f"{name}-{number}" for number in range(2, len(taken) + 2))
    return name if name not in taken else next(free for free in numbered if free not in taken)


def _connect(studio: Studio) -> State:
    if studio.connection.complete:
        return "done", "Images and gripper poses arrive."
    problems = studio.connection.problems
    return "to do", problems.get("wrist") or problems.get("robot") or "Waiting for image and pose."


def _record(studio: Studio) -> State:
    covered = studio.coverage()
    if covered.samples:
        return "done" if covered.ready else "to do", covered.verdict
    if not studio.connection.complete:
        return "waits", "Connect the camera and the robot first."
    return "to do", "Move the arm until the camera sees the work area; take the first sample."


def _learn(studio: Studio) -> State:
    found, covered = studio.calibrations.get("wrist"), studio.coverage()
    if found is not None and not studio.samples_changed:
        return "done", found.verdict
    if not covered.ready:
        return "waits", "The recording cannot be learned yet."
    if found is not None:
        return "to do", "The samples have changed since: learn them again."
    return "to do", f"{len(covered.samples)} images are ready to be learned."


def _fixed(studio: Studio) -> State:
    images, found = len(studio.fixed_images), studio.calibrations.get("fixed")
    if not studio.cell.scenes:
        return "waits", "Learn the scene first."
    if found is not None:
        return "done", found.verdict.replace("--camera", "--fixed-intrinsics")
    if studio.connection.devices.fixed_camera is None:
        return "waits", "No fixed camera was given; restart with --fixed SOURCE, or go on."
    if not images:
        return "to do", "Take images of the scene, 5 to 10."
    return "to do", f"{images} images; take more, or calibrate."


def _export(studio: Studio) -> State:
    if not studio.calibrations:
        return "waits", "There is no calibration to export yet."
    exported = len(list((studio.out / "export").glob("*")))
    if exported:
        return "done", f"{exported} files were exported."
    return "to do", "Choose a camera and a format."


STEPS: dict[str, Callable[[Studio], State]] = {
    "1 Connect": _connect,
    "2 Record": _record,
    "3 Learn": _learn,
    "4 Fixed": _fixed,
    "5 Export": _export,
}
"""All steps in order, each with its state."""
