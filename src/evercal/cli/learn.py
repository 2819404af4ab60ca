"""`evercal learn`."""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from evercal.cli.arguments import MAP, strategy_of
from evercal.cli.console import Bars, require_writable, size
from evercal.cli.networks import NetworkOptions, learn_into_networks
from evercal.cli.options import Device, File, Name, Store, Verb
from evercal.cli.reading import Reading
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.eye_in_hand import HandEyeReport
    from evercal.learning.scene import LearnReport
    from evercal.mapping.build import Adjusted
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Learn(Verb):
    """Learn a scene from a recording; scenes learned before do not change.

    A recording with gripper poses and no camera poses also yields gripper_from_camera. Several
    recordings become one scene each, several at once with --workers.

    Example: evercal learn cell.evercal wrist_recording/ --calibration wrist.json
    """

    store: Store
    """Folder of the map; created if it is missing."""
    recordings: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RECORDING...", help_behavior_hint="")
    ] = ()
    """Folders of recordings, or files of bags."""
    name: Name = None
    """Name of the scene. Default: the recording's own name."""
    memory: Annotated[str | None, arg(metavar="SHARE|BYTES|auto", help_behavior_hint="")] = None
    """Keyframes to keep: a share of the frames (10%), a size (5MB), or auto for the fewest that
    locate the recording's other frames well. Default: 10%, at least eight."""
    calibration: File = None
    """Also write the estimated gripper_from_camera to a file. The map keeps it in any case."""
    gripper_from_camera: File = None
    """A rough gripper_from_camera to compare the estimate with: 4x4 matrix or calibration file."""
    encoder: File = None
    """Encoder weights from 'python -m training', for a new map. Default: the shipped weights."""
    strategy: Name = None
    """evercal builds a map; every other strategy trains a network. Default: that of the store."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)
    """How the recording is read."""
    networks: Annotated[NetworkOptions, arg(name="")] = field(default_factory=NetworkOptions)
    """Strategies that train a network."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Recordings to learn in parallel."""
    device: Device = "auto"

    def run(self) -> int:
        if not self.recordings:
            raise InputError("no RECORDING given; name the folder of one or more")
        single = len(self.recordings) == 1
        if self.workers < 1 or (single and self.workers > 1):
            raise InputError(f"--workers {self.workers}: give 1 to the number of recordings")
        require_writable(self.calibration, "--calibration")
        if self.encoder is not None and not self.encoder.is_file():
            raise InputError(f"--encoder {self.encoder}: no such file")
        from evercal.mapping.memory_budget import MemoryBudget

        try:
            MemoryBudget.parse(self.memory)
        except InputError as error:
            raise InputError(f"--{error}") from None
        made_with = strategy_of(self.store)
        strategy = self.strategy or made_with or MAP
        if strategy != (made_with or strategy):
            raise InputError(
                f"--strategy {strategy}: {self.store} was made with {made_with}; omit the option or"
                " start a new store"
            )
        if strategy == MAP:
            self.networks.refuse()
        return self._run_one(self.recordings[0], strategy) if single else self._run_many(strategy)

    def _run_many(self, strategy: str) -> int:
        self._refuse(
            "several recordings are learned; omit the option or give one recording",
            name=self.name,
            calibration=self.calibration,
            gripper_from_camera=self.gripper_from_camera,
        )
        if strategy != MAP:
            raise InputError("several recordings: a network learns one at a time; give one")
        from evercal.map import Map

        loaded = [self.reading.recording(path, None) for path in self.recordings]
        cell = Map.open(self.store, device=self.device, encoder=self.encoder)
        with Bars(self._stream, f"{len(loaded)} recordings, {self.workers} at once") as bars:
            reports = cell.learn_many(
                loaded,
                workers=self.workers,
                memory=self.memory,
                on_scene=lambda report: bars.write("\n".join(summary(report))),
                on_progress=bars.step,
            )
        record = {"scenes": [dataclasses.asdict(report) for report in reports]}
        return self.answer(record, then=("localize", self.store, "IMAGE"))

    def _run_one(self, path: Path, strategy: str) -> int:
        from evercal.recordings.frame import lacks_camera_poses

        recording = self.reading.recording(path, self.name)
        if not lacks_camera_poses(recording):
            self._refuse(
                f"{recording.name} states camera poses, so gripper_from_camera is not estimated;"
                " omit the option",
                gripper_from_camera=self.gripper_from_camera,
                calibration=self.calibration,
            )
        try:
            report = self._learned(recording, strategy)
        except KeyboardInterrupt:
            print("stopped; the same command starts again", file=sys.stderr)
            return 130
        lines = summary(report)
        if self.calibration is not None:
            lines.append(f"wrote {self.calibration}")
        then = self._next(recording, report, path)
        return self.answer(dataclasses.asdict(report), lines, then)

    def _learned(self, recording: "Recording", strategy: str) -> "LearnReport":
        from evercal.calibration.calibration import read_transform

        rough = (
            None if self.gripper_from_camera is None else read_transform(self.gripper_from_camera)
        )
        frames = f"{len(recording.train)} training frames"
        with Bars(self._stream, f"{recording.name}: {frames}") as bars:
            if strategy != MAP:
                return learn_into_networks(self, strategy, recording, bars)
            from evercal.map import Map

            cell = Map.open(self.store, device=self.device, encoder=self.encoder)
            report = cell.learn(
                recording, memory=self.memory, gripper_from_camera=rough, on_progress=bars.step
            )
        if self.calibration is not None:
            cell.calibration(report.scene).write(self.calibration)
        return report

    def _next(
        self, recording: "Recording", report: "LearnReport", path: Path
    ) -> tuple[object, ...]:
        if report.hand_eye is not None:
            return "export", self.calibration or self.store, "--format", "easy_handeye2"
        if not recording.metric:
            return "align", self.store, report.scene, "IMAGE...", "--robot-poses", "FILE"
        if recording.test:
            scene = str(path) if self.name is None else f"{self.name}={path}"
            return "evaluate", self.store, scene
        return "localize", self.store, "IMAGE"

    @property
    def _stream(self) -> Any:
        return sys.stderr if self.json else sys.stdout

    @staticmethod
    def _refuse(why: str, **options: object) -> None:
        for name, value in options.items():
            if value is not None:
                raise InputError(f"--{name.replace('_', '-')} {value}: {why}")


def summary(report: "LearnReport") -> list[str]:
    """The outcome in lines."""
    lines = [
        f"mapped {report.scene}: {report.train_frames} images, {report.frames_kept} keyframes,"
        f" {report.landmarks:,} landmarks, {report.seconds:.0f} s; {size(report.memory_bytes)} for"
        " all scenes"
    ]
    if report.iterations:
        lines = [
            f"learned {report.scene}: {report.train_frames} images, {report.frames_kept} keyframes,"
            f" {report.iterations} steps, {report.seconds:.0f} s; {size(report.memory_bytes)} of"
            f" keyframes and {size(report.head_bytes)} of networks for all scenes"
        ]
    if report.hand_eye is not None:
        lines += hand_eye_lines(report.hand_eye)
    if report.adjusted is not None:
        lines += adjusted_lines(report.adjusted)
    return lines


def hand_eye_lines(report: "HandEyeReport") -> list[str]:
    """The estimated camera on the gripper in lines."""
    estimate = report.gripper_from_camera
    x, y, z = (1000 * value for value in report.translation_m)
    quaternion = ", ".join(f"{value:.5f}" for value in report.quaternion_wxyz)
    lines = [
        f"gripper_from_camera: ({x:.1f}, {y:.1f}, {z:.1f}) mm, quaternion wxyz ({quaternion});"
        f" standard deviation {estimate.sigma_mm:.2f} mm and {estimate.sigma_deg:.3f} deg per axis;"
        f" {report.pairs} of {report.of_pairs} image pairs are inliers"
    ]
    lines += [f"warning: {warning}" for warning in report.warnings]
    if report.given_mm is not None:
        lines.append(
            f"distance from the given one: {report.given_mm:.1f} mm and {report.given_deg:.1f} deg"
        )
    return lines


def adjusted_lines(adjusted: "Adjusted") -> list[str]:
    """What bundle adjustment changed, in lines."""
    shift = sum(x * x for x in adjusted.common_translation_mm) ** 0.5
    rotation = sum(x * x for x in adjusted.common_rotation_deg) ** 0.5
    residual = "-" if adjusted.residual_px is None else f"{adjusted.residual_px:.2f} px"
    lines = [
        f"bundle adjustment: median residual {residual}; stated poses accurate to"
        f" {adjusted.pose_sigma_mm:.1f} mm and {adjusted.pose_sigma_deg:.2f} deg per axis; common"
        f" offset {shift:.1f} mm and {rotation:.2f} deg; focal length"
        f" {adjusted.focal_percent:+.2f} %"
    ]
    from evercal.calibration.eye_in_hand import MOST_FOCAL_PERCENT

    if abs(adjusted.focal_percent) > MOST_FOCAL_PERCENT:
        lines.append(
            "warning: images and stated poses ask for a focal length"
            f" {adjusted.focal_percent:+.1f} % from the stated one; the intrinsics or the scale of"
            " the poses are wrong"
        )
    if abs(adjusted.time_shift_frames) > 0.02:
        lines.append(
            f"warning: the images lag their stated poses by {adjusted.time_shift_frames:+.2f} frame"
            " intervals; check the clocks"
        )
    if adjusted.wrong_poses:
        lines.append(
            f"warning: poses that contradict the images, left out: {_few(adjusted.wrong_poses)}"
        )
    if adjusted.untracked:
        lines.append(f"untracked images, left out: {_few(adjusted.untracked)}")
    if adjusted.doubtful_poses:
        lines.append(f"warning: poses with large errors: {_few(adjusted.doubtful_poses)}")
    return lines


def _few(names: tuple[str, ...], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
