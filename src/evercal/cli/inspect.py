"""`evercal inspect`."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next
from evercal.cli.options import File, Verb
from evercal.cli.reading import Reading
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.next_views import NextViews
    from evercal.geometry import SE3
    from evercal.live.coverage import Coverage
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Inspect(Verb):
    """Check a recording before it is learned: frames, cameras, motion, and likely mistakes.

    Example: evercal inspect wrist_recording/ --coverage --next reachable.csv
    """

    scene: Annotated[Positional[Path], arg(metavar="RECORDING")]
    """Folder of the recording, or file of a bag."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)
    """How the recording is read."""
    coverage: bool = False
    """Also measure every image of a wrist recording: what is covered, missing, blurred, doubled."""
    next: Annotated[Path | None, arg(metavar="POSES", help_behavior_hint="(default: none)")] = None
    """Gripper poses that the robot can reach; prints those whose images would help most."""
    count: Annotated[int, arg(metavar="N")] = 5
    """Number of poses for --next."""
    gripper_from_camera: File = None
    """A rough gripper_from_camera for --coverage and --next: 4x4 matrix or calibration file.
    Without it, axes are those of the gripper."""

    def run(self) -> int:
        """Read the recording and some of its images."""
        from evercal.recordings.inspection import inspect_recording

        recording = self.reading.recording(self.scene)
        found = inspect_recording(recording)
        covered, views = self._advice(recording)
        if self.json:
            print_json(asdict(found) | _advice_record(covered, views))
            return 0
        extent = " x ".join(f"{side:.2f}" for side in found.extent_m)
        whose = {"camera": "", "gripper": " with the gripper's pose"}.get(found.poses, "")
        print(f"{found.name}: {found.train} training and {found.test} test frames{whose}")
        print(f"  without a pose  {found.untracked}")
        for lens in found.cameras:
            print(f"  camera          {lens}")
        mover = "gripper" if found.poses == "gripper" else "camera"
        print(f"  {mover} moved in {extent} m (training frames)")
        if found.step_median_m is not None and found.step_largest_m is not None:
            print(
                f"  frame to frame  {100 * found.step_median_m:.1f} cm"
                f" and {found.step_median_deg:.1f} deg (median),"
                f" {found.step_largest_m:.2f} m at most"
            )
        if found.near_training is not None:
            print(
                f"  near training   {found.near_training:.1f} % of the test frames lie within 5 cm"
                f" and 5 deg of a training frame"
            )
        for note in found.notes:
            print(f"note: {note}")
        for warning in found.warnings:
            print(f"warning: {warning}")
        _print_advice(covered, views)
        print_next("evercal", "learn", "STORE", self.scene, *self.reading.words())
        return 0

    def _advice(self, recording: "Recording") -> "tuple[Coverage | None, NextViews | None]":
        """Coverage and next poses, if asked for."""
        if not self.coverage and self.next is None:
            return None, None
        from evercal.calibration.calibration import read_transform
        from evercal.geometry import SE3
        from evercal.live.coverage import Sample, coverage

        frames = [frame for frame in recording.train if frame.base_from_gripper is not None]
        poses = SE3.stack([f.base_from_gripper for f in frames if f.base_from_gripper is not None])
        if not frames:
            raise InputError(
                f"{self.scene}: states no gripper poses; --coverage and --next need them"
            )
        given = self.gripper_from_camera
        rough = None if given is None else read_transform(given)
        covered = None
        if self.coverage:
            covered = coverage([Sample.of(frame) for frame in frames], rough)
        return covered, None if self.next is None else self._next_views(poses, rough)

    def _next_views(self, poses: "SE3", rough: "SE3 | None") -> "NextViews":
        from evercal.calibration.next_views import next_views
        from evercal.recordings import read_robot_poses

        assert self.next is not None
        reachable = read_robot_poses(
            self.next, self.reading.pose_convention, option="--pose-convention"
        )
        return next_views(poses, reachable.poses, self.count, rough)


def _advice_record(covered: "Coverage | None", views: "NextViews | None") -> dict[str, object]:
    """The parts that were asked for, as JSON values."""
    record: dict[str, object] = {}
    if covered is not None:
        record["coverage"] = asdict(covered)
    if views is not None:
        record["next"] = [
            {
                "row": int(views.index[i]) + 1,
                "translation_m": pose.translation_m.tolist(),
                "quaternion_wxyz": pose.rotation_wxyz.tolist(),
                "sigma_mm": views.sigma_mm[i + 1],
                "sigma_deg": views.sigma_deg[i + 1],
            }
            for i, pose in enumerate(views.poses)
        ]
    return record


def _print_advice(covered: "Coverage | None", views: "NextViews | None") -> None:
    if covered is not None:
        print(f"  {covered.verdict}")
        for axis in covered.rotations:
            print(f"  rotation        {axis.spread:.0f} deg {axis.name} (standard deviation)")
        for axis in covered.positions:
            print(f"  position        {axis.spread:.0f} mm {axis.name} (standard deviation)")
        for sample in covered.samples:
            for problem in sample.problems:
                print(f"  {sample.name}: {problem}")
    if views is not None:
        print(f"  expected sigma  {views.sigma_mm[0]:.2f} mm, {views.sigma_deg[0]:.3f} deg now")
        for i, pose in enumerate(views.poses):
            x, y, z = pose.translation_m
            print(
                f"  next {i + 1}          row {views.index[i] + 1}: {x:+.3f} {y:+.3f} {z:+.3f} m,"
                f" then {views.sigma_mm[i + 1]:.2f} mm, {views.sigma_deg[i + 1]:.3f} deg"
            )
