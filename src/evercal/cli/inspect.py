"""`evercal inspect`."""

from collections.abc import Iterator
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import numbers, require_writable
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.from_map.next_views import NextViews
    from evercal.geometry import SE3
    from evercal.live.coverage import Coverage
    from evercal.recordings import Recording
    from evercal.recordings.inspection import Inspection


@frozen
class Inspect(args.Verb):
    """Check a recording before it is learned; likely mistakes are named.

    Example: evercal inspect wrist_recording/ --coverage --next reachable.csv
    """

    scene: Annotated[Positional[Path], arg(metavar="RECORDING")]
    """Folder of the recording, or file of a bag."""
    reading: args.HowRead = field(default_factory=args.Reading)
    coverage: bool = False
    """Also measure every image of a wrist recording: what is covered, missing, blurred, doubled."""
    next: Annotated[Path | None, args.shown("POSES", "(default: none)")] = None
    """Gripper poses that the robot can reach; prints those whose images would help most."""
    count: args.Number = 5
    """Number of poses for --next."""
    out: args.OutFile = Path("joint-map.json")
    """Joint map to write, if the images show that joint values are to be read in another way."""
    gripper_from_camera: args.File = None
    """A rough gripper_from_camera for --coverage and --next: 4x4 matrix or calibration file.
    Without it, axes are those of the gripper."""

    def run(self) -> int:
        from evercal.recordings.inspection import STILL, inspect_recording

        recording = self.reading.recording(self.scene, unchecked_joints=True)
        inspection = inspect_recording(recording)
        record = asdict(inspection)
        lines = list(_lines(inspection))
        if inspection.poses == "gripper":
            from evercal.calibration.from_map.next_views import open_position
            from evercal.recordings.frame import stated_grippers

            rough = args.transform_of(self.gripper_from_camera)
            open = open_position(stated_grippers(recording.train), rough)
            record["open_position"] = open and asdict(open)
            if open:
                lines.append(f"warning: {open.sentence()}")
        if self.coverage or self.next:
            self._advise(recording, record, lines)
        verb = ["learn", "MAP"]
        still = STILL in str(inspection.warnings)
        if still:
            verb = ["arm-in-view"] if recording.arm else ["eye-to-hand"]
        reading = self._joints(recording, still, record, lines)
        then = [*verb, self.scene, *reading.words()]
        self.answer(record, *lines, then=then)
        return 0

    def _joints(
        self,
        recording: "Recording",
        still: bool,
        record: dict[str, object],
        lines: list[str],
    ) -> args.Reading:
        """Compare joint values with the images, and write how to read them; how to read next."""
        from evercal.calibration.from_map.joint_check import (
            joint_sentence,
            recorded_joints,
        )
        from evercal.robot.joint_agreement import OFFSET
        from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND
        from evercal.storage import write_json

        verdict = recorded_joints(recording, EYE_TO_HAND if still else EYE_IN_HAND)
        if not verdict or verdict.agrees:
            return self.reading
        if not verdict.readings and still:  # the images may show nothing but the arm
            return self.reading
        sentence = joint_sentence(verdict)
        lines.append(f"warning: {sentence}")
        found: dict[str, object] = {"sentence": sentence}
        record["joints"] = found
        arm = recording.arm
        if not verdict.readings or not arm or not arm.read:
            return self.reading
        require_writable(self.out, "--out")
        reading = verdict.readings[0].reading
        joint_map = arm.read.after(reading[:, :OFFSET], reading[:, OFFSET])
        write_json(self.out, joint_map.record(arm.rotates().tolist()))
        found["joint_map"] = str(self.out)
        lines.append(f"  joint map       {self.out} reads them so")
        return replace(self.reading, joint_map=self.out)

    def _advise(
        self, recording: "Recording", record: dict[str, object], lines: list[str]
    ) -> None:
        """Add coverage and next poses, as far as asked for."""
        from evercal.live.coverage import Sample, coverage
        from evercal.recordings.frame import stated_grippers

        poses = stated_grippers(recording.train)
        if not len(poses):
            raise InputError(
                f"{self.scene}: states no gripper poses; --coverage and --next need them"
            )
        rough = args.transform_of(self.gripper_from_camera)
        if self.coverage:
            frames = [f for f in recording.train if f.base_from_gripper]
            covered = coverage(list(map(Sample.of, frames)), rough)
            record["coverage"] = asdict(covered)
            lines += _coverage_lines(covered)
        if self.next:
            views = self._next_views(self.next, poses, rough)
            record["next"] = _next_records(views)
            lines += _next_lines(views)

    def _next_views(self, file: Path, poses: "SE3", rough: "SE3 | None") -> "NextViews":
        from evercal.calibration.from_map.next_views import next_views
        from evercal.recordings import read_robot_poses

        convention = self.reading.pose_convention
        reachable = read_robot_poses(file, convention, option="--pose-convention")
        return next_views(poses, reachable.poses, self.count, rough)


def _lines(found: "Inspection") -> Iterator[str]:
    mover = "camera"
    poses = ""
    if found.poses == "gripper":
        mover = "gripper"
        poses = " with the gripper's pose"
    unit = "m" if found.metric else "units"
    yield f"{found.name}: {found.train} training and {found.test} test frames{poses}"
    yield f"  without a pose  {found.untracked}"
    for camera in found.cameras:
        yield f"  camera          {camera}"
    extent = " x ".join(map("{:.3g}".format, found.extent_m))
    yield f"  {mover} moved in {extent} {unit} (training frames)"
    if found.step_median_m is not None and found.step_largest_m is not None:
        middle = f"{found.step_median_m:.3g} {unit} and {found.step_median_deg:.1f} deg"
        yield f"  frame to frame  {middle} (median), {found.step_largest_m:.3g} {unit} at most"
    if found.near_training is not None:
        near = f"{found.near_training:.1f} % of the test frames"
        yield f"  near training   {near} lie within 5 cm and 5 deg of a training frame"
    yield from map("note: {}".format, found.notes)
    yield from map("warning: {}".format, found.warnings)


def _coverage_lines(covered: "Coverage") -> Iterator[str]:
    yield f"  {covered.verdict}"
    for what, unit, axes in (
        ("rotation", "deg", covered.rotations),
        ("position", "mm", covered.positions),
    ):
        for axis in axes:
            yield f"  {what}        {axis.spread:.0f} {unit} {axis.name} (standard deviation)"
    for sample in covered.samples:
        for problem in sample.problems:
            yield f"  {sample.name}: {problem}"


def _next_records(views: "NextViews") -> list[dict[str, object]]:
    from evercal.geometry import pose_to_dict

    records = []
    for i, pose in enumerate(views.poses):
        record = pose_to_dict(pose) or {}
        record["row"] = int(views.index[i]) + 1
        record["sigma_mm"] = views.sigma_mm[i + 1]
        record["sigma_deg"] = views.sigma_deg[i + 1]
        records.append(record)
    return records


def _next_lines(views: "NextViews") -> Iterator[str]:
    now, *then = map("{:.2f} mm, {:.3f} deg".format, views.sigma_mm, views.sigma_deg)
    yield f"  expected sigma  {now} now"
    for i, pose in enumerate(views.poses):
        row = f"row {views.index[i] + 1}: {numbers(pose.translation_m, '+.3f')} m"
        yield f"  next {i + 1}          {row}, then {then[i]}"
