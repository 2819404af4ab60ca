"""`evercal inspect`."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.options import File, Verb
from evercal.cli.reading import Reading
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.next_views import NextViews
    from evercal.geometry import SE3
    from evercal.live.coverage import Coverage
    from evercal.recordings import Recording
    from evercal.recordings.inspection import Inspection


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
        from evercal.recordings.inspection import inspect_recording

        recording = self.reading.recording(self.scene)
        found = inspect_recording(recording)
        covered, views = self._advice(recording)
        lines = [*_found_lines(found), *_advice_lines(covered, views)]
        then = ("learn", "MAP", self.scene, *self.reading.words())
        return self.answer(asdict(found) | _advice_record(covered, views), lines, then)

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


def _found_lines(found: "Inspection") -> list[str]:
    extent = " x ".join(f"{side:.2f}" for side in found.extent_m)
    whose = {"camera": "", "gripper": " with the gripper's pose"}.get(found.poses, "")
    mover = "gripper" if found.poses == "gripper" else "camera"
    lines = [
        f"{found.name}: {found.train} training and {found.test} test frames{whose}",
        f"  without a pose  {found.untracked}",
        *(f"  camera          {lens}" for lens in found.cameras),
        f"  {mover} moved in {extent} m (training frames)",
    ]
    if found.step_median_m is not None and found.step_largest_m is not None:
        lines.append(
            f"  frame to frame  {100 * found.step_median_m:.1f} cm"
            f" and {found.step_median_deg:.1f} deg (median), {found.step_largest_m:.2f} m at most"
        )
    if found.near_training is not None:
        lines.append(
            f"  near training   {found.near_training:.1f} % of the test frames lie within 5 cm"
            f" and 5 deg of a training frame"
        )
    lines += [f"note: {note}" for note in found.notes]
    return [*lines, *(f"warning: {warning}" for warning in found.warnings)]


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


def _advice_lines(covered: "Coverage | None", views: "NextViews | None") -> list[str]:
    lines = list[str]()
    if covered is not None:
        lines.append(f"  {covered.verdict}")
        for what, unit, axes in (
            ("rotation", "deg", covered.rotations),
            ("position", "mm", covered.positions),
        ):
            lines += [
                f"  {what}        {axis.spread:.0f} {unit} {axis.name} (standard deviation)"
                for axis in axes
            ]
        lines += [f"  {sample.name}: {p}" for sample in covered.samples for p in sample.problems]
    if views is not None:
        sigmas = [
            f"{mm:.2f} mm, {deg:.3f} deg"
            for mm, deg in zip(views.sigma_mm, views.sigma_deg, strict=True)
        ]
        lines.append(f"  expected sigma  {sigmas[0]} now")
        for i, pose in enumerate(views.poses):
            x, y, z = pose.translation_m
            lines.append(
                f"  next {i + 1}          row {views.index[i] + 1}: {x:+.3f} {y:+.3f} {z:+.3f} m,"
                f" then {sigmas[i + 1]}"
            )
    return lines
