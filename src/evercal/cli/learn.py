"""`evercal learn`."""

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from dataclasses import field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.calibrate import held_out_lines, joint_lines, lens_lines
from evercal.cli.console import motion, require_writable, say, say_notes, size
from evercal.cli.info import adjusted_row
from evercal.cli.training import Training, observer
from evercal.errors import InputError
from evercal.progress import Bars

if TYPE_CHECKING:
    from evercal.learning.report import LearnReport
    from evercal.recordings import Recording

MOST_LINES = 8
"""Images that were set aside, at most, with a line each; the map keeps the errors of all."""
FEW_LANDMARKS = 50
"""Landmarks a keyframe; of a dark, overexposed or blurred room with 9, 21, 58 and 83 of them, 50,
60, 100 and 90 % of the images were located."""


@frozen
class NetworkOptions(Training):
    """Options of strategies that train a network; a map refuses them."""

    weight: Annotated[float | None, args.shown("W")] = None
    """Weight of what protects earlier scenes: that of the replayed rows, alpha of GEC or
    strength of EWC. Default: that of the strategy."""
    seed: int = 0
    """Random seed."""

    def refuse(self) -> None:
        """Refuse options that a map does not have."""
        for option in fields(self):
            value = getattr(self, option.name)
            if value != option.default:
                raise InputError(
                    f"{args.option(option.name)} {value}: a map is not trained; omit the option, or"
                    " choose a network with --strategy"
                )


@frozen
class Learn(args.Verb):
    """Learn a scene from a recording; a map's other scenes do not change.

    A recording with gripper poses and no camera poses also yields gripper_from_camera. Several
    recordings become one scene each, several at once with --workers. A new map gets a new folder.

    Example: evercal learn cell.evercal wrist_recording/ --calibration wrist.json
    """

    writes = ("store", "calibration", "results", "ray", "replace")
    store: args.Store
    recordings: Annotated[Positional[tuple[str, ...]], args.shown("RECORDING...")] = ()
    """Folders of recordings, files of bags, or addresses such as s3://bucket/folder."""
    name: args.Name = None
    """Name of the scene. Default: the recording's own name."""
    base: args.Name = None
    """Name of the robot's base. Scenes of one place in one base give one answer; without a name,
    learning compares their poses."""
    replace: args.Name = None
    """Name of a scene that the new one replaces: the room or the base was moved."""
    memory: Annotated[str | None, args.shown("SHARE|BYTES|auto")] = None
    """Keyframes to keep: a share of the frames (10%), a size (5MB), or auto for the fewest that
    locate the recording's other frames well. Default: 10%, at least eight."""
    calibration: args.File = None
    """Also write the estimated gripper_from_camera to a file. The map keeps it in any case."""
    gripper_from_camera: args.File = None
    """A rough gripper_from_camera to compare the estimate with: 4x4 matrix or calibration file."""
    encoder: args.File = None
    """An encoder as ONNX file, for a new map. Default: the shipped one."""
    strategy: args.Name = None
    """evercal builds a map; every other strategy trains a network. Default: that of the store."""
    reading: args.HowRead = field(default_factory=args.Reading)
    which: args.WhichArm = field(default_factory=args.ArmGiven)
    networks: Annotated[NetworkOptions, arg(name="")] = field(
        default_factory=NetworkOptions
    )
    workers: args.Number = 1
    """Recordings to learn in parallel."""
    ray: args.Address = None
    """Learn on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT. All its machines reach the
    recordings."""
    results: Annotated[str | None, args.shown("DIR|ADDRESS")] = None
    """Keep every learned scene there, so that the same command goes on after a stop."""

    def run(self) -> int:
        if not self.recordings:
            raise InputError("no RECORDING given; name the folder of one or more")
        from evercal.recordings.addresses import is_address

        single = len(self.recordings) == 1 and not is_address(self.recordings[0])
        single = single and not (self.ray or self.results)
        if self.ray is not None and self.workers != 1:
            raise InputError(
                f"--workers {self.workers}: --ray has its own; omit one of them"
            )
        if self.workers < 1 or (single and self.workers > 1):
            raise InputError(
                f"--workers {self.workers}: give 1 to the number of recordings"
            )
        require_writable(self.calibration, "--calibration")
        if self.encoder and not self.encoder.is_file():
            raise InputError(f"--encoder {self.encoder}: no such file")
        from evercal.mapping.memory_budget import MemoryBudget

        try:
            MemoryBudget.parse(self.memory)
        except InputError as error:
            raise InputError(f"--{error}") from None
        made_with = args.strategy_of(self.store)
        strategy = self.strategy or made_with or args.MAP
        if strategy != (made_with or strategy):
            raise InputError(
                f"--strategy {strategy}: {self.store} was made with {made_with}; omit the option or"
                " start a new store"
            )
        if strategy == args.MAP:
            self.networks.refuse()
        if single:
            return self._run_one(Path(self.recordings[0]), strategy)
        return self._run_many(strategy)

    def _run_many(self, strategy: str) -> int:
        why = "is for one recording, without --ray, --results and addresses; omit one of them"
        self._refuse(why, "name", "replace", "calibration", "gripper_from_camera")
        if strategy != args.MAP:
            raise InputError(
                "a network learns one recording of this machine; give one folder"
            )
        from evercal.map import Map
        from evercal.recordings.load import format_of

        cell = Map.open(self.store, encoder=self.encoder)
        where = f"{self.workers} at once"
        if self.ray is not None:
            where = f"on Ray at {self.ray}"
        plural = "s" if len(self.recordings) > 1 else ""
        start = f"{len(self.recordings)} recording{plural}, {where}"
        with Bars(self.log, start) as bars:

            def show(report: "LearnReport") -> None:
                bars.write("\n".join(summary(report, self.store)))

            read = partial(read_recording, self.reading)
            vars(read)["check"] = format_of  # see `LearnTask.read`
            reports = cell.learn_many(
                self.recordings,
                read=read,
                workers=self.workers,
                ray=self.ray,
                results=self.results,
                base=self.base,
                memory=self.memory,
                on_scene=show,
                on_progress=bars.step,
            )
        record = {"scenes": [report.to_dict() for report in reports]}
        self.answer(record, then=("localize", self.store, "IMAGE"))
        return 0

    def _run_one(self, path: Path, strategy: str) -> int:
        from evercal.recordings.frame import lacks_camera_poses

        recording = read_recording(self.reading, path, self.name)
        if not lacks_camera_poses(recording):
            why = "states camera poses, so gripper_from_camera is not estimated; omit the option"
            self._refuse(
                f"{recording.name} {why}", "gripper_from_camera", "calibration"
            )
        try:
            report = self._learned(recording, strategy)
        except KeyboardInterrupt:
            print("stopped; run the same command again", file=sys.stderr)
            return 130
        lines = list(summary(report, self.calibration or self.store))
        if self.calibration:
            lines.append(f"wrote {self.calibration}")
        then = self._next(recording, report, path)
        self.answer(report.to_dict(), *lines, then=then)
        return 0

    def _learned(self, recording: "Recording", strategy: str) -> "LearnReport":
        rough = args.transform_of(self.gripper_from_camera)
        start = f"{recording.name}: {len(recording.train)} training frames"
        with Bars(self.log, start) as bars:
            if strategy != args.MAP:
                self._refuse("is for a map; omit the option", "base", "replace")
                return learn_into_networks(self, strategy, recording, bars)
            from evercal.map import Map
            from evercal.mapping.build import MapOptions

            cell = Map.open(self.store, encoder=self.encoder)
            report = cell.learn(
                recording,
                base=self.base,
                replace=self.replace,
                memory=self.memory,
                gripper_from_camera=rough,
                options=MapOptions(errors=self.which.errors()),
                on_progress=bars.step,
            )
        if self.calibration:
            cell.calibration(report.scene).write(self.calibration)
        return report

    def _next(
        self, recording: "Recording", report: "LearnReport", path: Path
    ) -> Sequence[object]:
        if report.hand_eye:
            file = self.calibration or f"{self.store}:{report.scene}"
            return args.next_words(report.hand_eye.calibration, file)
        if not recording.metric:
            images = ("IMAGE...", "--robot-poses", "FILE")
            return "align", self.store, report.scene, *images
        if recording.test and self.name:
            return "evaluate", self.store, f"{self.name}={path}"
        if recording.test:
            return "evaluate", self.store, path
        return "localize", self.store, "IMAGE"

    def _refuse(self, why: str, *names: str) -> None:
        """Refuse options that were given and do not apply."""
        for name in names:
            value = getattr(self, name)
            if value is not None:
                raise InputError(f"{args.option(name)} {value}: {why}")


def read_recording(
    reading: args.Reading, path: Path, name: str | None = None
) -> "Recording":
    """Read a recording and say what its images lack, before the work."""
    from evercal.recordings.pictures import look_at

    recording = reading.recording(path, name)
    say_notes(recording.notes)
    pictures = look_at(recording.train)
    if pictures.usable:
        for warning in pictures.warnings:
            say(f"warning: {recording.name}: {warning}", sys.stderr)
    return recording


def learn_into_networks(
    given: Learn, strategy: str, recording: "Recording", bars: "Bars"
) -> "LearnReport":
    """Train a network on a recording."""
    from evercal.continual.learning.learn_networks import (
        NetworkLearnOptions,
        learn_networks,
    )
    from evercal.continual.store import NetworkStore
    from evercal.continual.strategies import strategy_named
    from evercal.storage.stages import is_store

    wanted = given.networks
    if wanted.seed < 0:
        raise InputError(f"--seed {wanted.seed}: give a number >= 0")
    wanted.load_plugin()
    chosen = wanted.strategy(strategy)
    if is_store(given.store):
        # The weight is that of the network which the store has.
        for head in NetworkStore.open(given.store).contents.heads[-1:]:
            paper_head = head.options.condition == "descriptor"
            chosen = strategy_named(strategy, paper_head)
    if wanted.weight is not None:
        chosen = chosen.weighted(wanted.weight)
    options = NetworkLearnOptions(
        strategy=chosen,
        preset=wanted.preset,
        stage=wanted.stage(wanted.seed, given.memory),
        encoder=given.encoder,
        device=wanted.device,
    )
    return learn_networks(given.store, recording, options, observer(bars))


def summary(report: "LearnReport", file: Path) -> Iterator[str]:
    """The outcome in lines; `file` holds the calibration, if there is one."""
    kept = (
        f"{report.scene}: {report.train_frames} images, {report.frames_kept} keyframes"
    )
    memory = size(report.memory_bytes)
    networks = report.to_dict()
    if networks["iterations"]:
        yield (
            f"learned {kept}, {networks['iterations']} steps, {report.seconds:.0f} s; {memory} of"
            f" keyframes and {size(networks['head_bytes'])} of networks for all scenes"
        )
    else:
        yield (
            f"mapped {kept}, {report.landmarks:,} landmarks, {report.seconds:.0f} s; {memory} for"
            " all scenes"
        )
        if report.landmarks < FEW_LANDMARKS * report.frames_kept:
            few = f"{report.landmarks / report.frames_kept:.0f} landmarks a keyframe are few"
            yield f"warning: {few}: most images will be refused; record sharper and textured views"
    if report.fixed_share:
        share = f"{100 * report.fixed_share:.1f} % of the image shows the same in all images"
        yield f"{share}, such as text or the gripper: left out"
    for other in report.same_place:
        if other.same_base:
            yield other.agreement
    for name, error in [*report.set_aside.items()][:MOST_LINES]:
        how = "not aligned"
        if error:
            parts = ["{:.2f} mm", "{:.3f} deg"][-len(error) :]
            how = f"aligned {', '.join(parts).format(*error)} from its stated pose"
        yield f"  set aside    {name}: {how}"
    yield from map("warning: {}".format, report.warnings)
    found = report.hand_eye
    if found:
        pose = found.parent_from_camera
        position = ", ".join(map("{:.1f}".format, 1000 * pose.pose.translation_m))
        quaternion = ", ".join(map("{:.5f}".format, pose.pose.rotation_wxyz))
        yield (
            f"gripper_from_camera: ({position}) mm, quaternion wxyz ({quaternion});"
            f" standard deviation {motion(pose.sigma_mm, pose.sigma_deg, ' and ')} per axis;"
            f" {found.pairs} of {found.of_pairs} image pairs are inliers"
        )
        yield from lens_lines(found.calibration)
        yield from held_out_lines(found.calibration)
        yield from map("warning: {}".format, found.warnings)
        if found.advice:
            yield f"warning: {found.advice}"
        if found.given_mm is not None:
            far = f"{found.given_mm:.1f} mm and {found.given_deg:.1f} deg"
            yield f"distance from the given one: {far}"
        yield from joint_lines(found.calibration.joints, file)
    if report.adjusted:
        row = adjusted_row(report.scene, dataclasses.asdict(report.adjusted))
        yield "; ".join(map("{} {}".format, row, row.values()))
        if report.adjusted.untracked:
            from evercal.storage.text_files import few

            yield f"untracked images, left out: {few(report.adjusted.untracked, most=8)}"
