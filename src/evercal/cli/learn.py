"""`evercal learn`."""

import dataclasses
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, require_writable, size
from evercal.cli.device import Device
from evercal.cli.networks import Bars, LearnRequest, NetworkOptions, learn_into_networks
from evercal.cli.reading import Reading
from evercal.cli.stores import MAP, strategy_of
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.eye_in_hand import HandEyeReport
    from evercal.geometry import SE3
    from evercal.learning.scene import LearnReport
    from evercal.mapping.build import Adjusted
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Learn:
    """Learn a scene from a recording; scenes learned before do not change.

    A recording with gripper poses and no camera poses also yields gripper_from_camera. Several
    recordings become one scene each, several at once with --workers. Training of a network
    continues where it was stopped.

    Example: evercal learn cell.evercal wrist_recording/ --calibration wrist.json
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the map; created if it is missing."""
    recordings: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RECORDING...", help_behavior_hint="")
    ] = ()
    """Folders of recordings, or files of bags."""
    name: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """Name of the scene. Default: the recording's own name."""
    memory: Annotated[str | None, arg(metavar="SHARE|BYTES|auto", help_behavior_hint="")] = None
    """Keyframes to keep: a share of the frames (10%), a size (5MB), or auto for the fewest that
    locate the recording's other frames well. Default: 10%, at least eight."""
    calibration: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Output file for the estimated gripper_from_camera, for 'evercal export'."""
    gripper_from_camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """A rough gripper_from_camera to compare the estimate with: 4x4 matrix or calibration file."""
    encoder: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Encoder weights from 'evercal pretrain', for a new store. Default: the shipped weights."""
    strategy: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """evercal builds a map; every other strategy trains a network. Default: that of the store."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)
    """How the recording is read."""
    networks: Annotated[NetworkOptions, arg(name="")] = field(default_factory=NetworkOptions)
    """Strategies that train a network."""
    workers: Annotated[int, arg(metavar="N")] = 1
    """Recordings that are learned at once; the threads of this machine are shared."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Learn and print a summary."""
        if not self.recordings:
            raise InputError("no RECORDING given; name the folder of one or more")
        if self.workers < 1:
            raise InputError(f"--workers {self.workers}: give a number >= 1")
        return self._run_one(self.recordings[0]) if len(self.recordings) == 1 else self._run_many()

    def _run_many(self) -> int:
        """Learn several recordings; print a summary of each."""
        self._refuse(
            "several recordings are learned; omit the option or give one recording",
            name=self.name,
            calibration=self.calibration,
            gripper_from_camera=self.gripper_from_camera,
        )
        if (self.strategy or strategy_of(self.store) or MAP) != MAP:
            raise InputError("several recordings: a network learns one at a time; give one")
        self._require_parsed_memory()
        self.networks.refuse()
        from evercal.map import Map

        loaded = [self.reading.recording(path, None) for path in self.recordings]
        cell = Map.open(self.store, device=self.device, encoder=self._encoder())
        stream = sys.stderr if self.json else sys.stdout
        with Bars(f"{len(loaded)} recordings, {self.workers} at once", stream) as bars:

            def show(report: "LearnReport") -> None:
                bars.write("\n".join(summary(report)))

            reports = cell.learn_many(
                loaded,
                workers=self.workers,
                memory=self.memory,
                on_scene=show,
                on_progress=bars.step,
            )
        if self.json:
            print_json({"scenes": [dataclasses.asdict(report) for report in reports]})
            return 0
        print_next("evercal", "localize", self.store, "IMAGE")
        return 0

    def _run_one(self, path: Path) -> int:
        if self.workers > 1:
            raise InputError(f"--workers {self.workers}: one recording is learned; omit the option")
        require_writable(self.calibration, "--calibration")
        self._require_parsed_memory()
        from evercal.recordings import posed_recording
        from evercal.recordings.frame import lacks_camera_poses
        from evercal.recordings.held_out import split_held_out

        recording = self.reading.recording(path, self.name)
        if not lacks_camera_poses(recording):
            self._refuse(
                f"{recording.name} states camera poses, so gripper_from_camera is not estimated;"
                " omit the option",
                gripper_from_camera=self.gripper_from_camera,
                calibration=self.calibration,
            )
            recording = posed_recording(recording)
        held_out = len(split_held_out(recording.train).held_out)
        start = (
            f"{recording.name}: {len(recording.train)} training frames ({recording.untracked}"
            f" without a pose omitted), {held_out} held out to fit acceptance"
        )
        try:
            report = self._learn(recording, start)
        except KeyboardInterrupt:
            print("stopped; the same command continues or starts again", file=sys.stderr)
            return 130
        if self.calibration is not None and report.hand_eye is not None:
            from evercal.calibration.learned import learned_calibration

            learned_calibration(self.store, report.scene).write(self.calibration)
        if self.json:
            print_json(dataclasses.asdict(report))
            return 0
        for line in summary(report):
            print(line)
        if self.calibration is not None:
            print(f"wrote {self.calibration}")
            print_next("evercal", "export", self.calibration, "--format", "easy_handeye2")
        elif not recording.metric:
            align = ("evercal", "align", self.store, report.scene)
            print_next(*align, "IMAGE...", "--robot-poses", "FILE")
        elif recording.test:
            scene = str(path) if self.name is None else f"{self.name}={path}"
            print_next("evercal", "evaluate", self.store, scene)
        else:
            print_next("evercal", "localize", self.store, "IMAGE")
        return 0

    def _learn(self, recording: "Recording", start: str) -> "LearnReport":
        stream = sys.stderr if self.json else sys.stdout
        made_with = strategy_of(self.store)
        strategy = self.strategy or made_with or MAP
        if made_with is not None and strategy != made_with:
            raise InputError(
                f"--strategy {strategy}: {self.store} was made with {made_with}; omit the option or"
                " start a new store"
            )
        encoder = self._encoder()
        rough = self._rough()
        if strategy != MAP:
            request = LearnRequest(
                self.store,
                strategy,
                self.memory or "10%",
                encoder,
                self.device,
                rough,
                self.networks,
            )
            return learn_into_networks(request, recording, start, stream)
        self.networks.refuse()
        from evercal.map import Map

        cell = Map.open(self.store, device=self.device, encoder=encoder)
        with Bars(start, stream) as bars:
            return cell.learn(
                recording, memory=self.memory, gripper_from_camera=rough, on_progress=bars.step
            )

    def _rough(self) -> "SE3 | None":
        if self.gripper_from_camera is None:
            return None
        from evercal.calibration.calibration import read_transform

        return read_transform(self.gripper_from_camera)

    def _encoder(self) -> Path | None:
        if self.encoder is not None and not self.encoder.is_file():
            raise InputError(f"--encoder {self.encoder}: no such file")
        return self.encoder

    def _require_parsed_memory(self) -> None:
        from evercal.mapping.memory_budget import MemoryBudget

        try:
            MemoryBudget.parse(self.memory)
        except InputError as error:
            raise InputError(f"--{error}") from None

    @staticmethod
    def _refuse(why: str, **options: object) -> None:
        """Refuse options that were given and do not apply."""
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
