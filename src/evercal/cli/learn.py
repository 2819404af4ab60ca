"""`evercal learn`."""

import dataclasses
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, size
from evercal.cli.device import Device
from evercal.cli.learn_bars import LearnBars
from evercal.cli.reading import Reading
from evercal.errors import InputError
from evercal.mapping import memory_budget

if TYPE_CHECKING:
    from evercal.calibration.eye_in_hand import HandEyeReport
    from evercal.continual.learn_scene import LearnOptions, LearnReport
    from evercal.geometry import Camera
    from evercal.mapping.build import Adjusted


@dataclass(frozen=True)
class Learn:
    """Learn a scene into a store; the scenes it knows stay as they are.

    The same command goes on where it was stopped.
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store; made when it is missing."""
    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder of the recorded scene, or file of a bag."""
    name: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """What the scene is called in the store; its own name when left out."""
    strategy: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The strategy evercal builds a map of keyframes and landmarks; all others train a network. A
    store keeps the strategy it was made with."""
    preset: Literal["fast", "demo", "bench", "paper"] = "fast"
    """How much a network is trained: fast takes minutes on two cores, paper needs a GPU. A map
    takes no notice of it."""
    memory: Annotated[str, arg(metavar="SHARE|BYTES|auto")] = "10%"
    """How many keyframes are kept of the scene: a share of its frames (10%), bytes (5MB), or auto:
    the fewest with which its other frames are located well."""
    centres: Annotated[int | None, arg(metavar="M", help_behavior_hint="")] = None
    """How many cluster centres a scene adds to a network; the preset's number when left out."""
    encoder: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of encoder weights from 'evercal pretrain', for a new store; else the shipped ones."""
    reading: Annotated[Reading, arg(name="")] = field(default_factory=Reading)
    """How the recording is read."""
    gripper_from_camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where the camera roughly sits on the gripper, a 4x4 matrix or a calibration file, for a
    recording that states gripper poses only: what is found from the images is compared with it."""
    calibration: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where to write the gripper_from_camera that was found, for 'evercal export'."""
    device: Device = "auto"
    seed: int = 0
    """Seed of all that is drawn at random."""
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Learns, shows how it goes, and says what came out."""
        if self.memory.strip().lower() != memory_budget.AUTO:
            parse_memory(self.memory)  # refused before anything is read
        if self.centres is not None and self.centres < 1:
            raise InputError(f"--centres {self.centres}: give a number >= 1")
        if self.seed < 0:
            raise InputError(f"--seed {self.seed}: give a number >= 0")
        from evercal.calibration.eye_in_hand import lacks_camera_poses
        from evercal.continual.learn_scene import learn_scene, validation_split
        from evercal.recordings import posed_recording

        scene = self.reading.scene(self.scene, self.name)
        wrist = lacks_camera_poses(scene)
        if not wrist:
            self._refuse_hand_eye(scene.name)
            scene = posed_recording(scene)
        check_name(scene.name)
        options = self._options()
        held_out = len(validation_split(scene.train)[1])
        start = (
            f"{scene.name}: {len(scene.train)} training frames, {scene.untracked} untracked left"
            f" out, {held_out} held out to set the unknown_scene threshold"
        )
        try:
            with LearnBars(start, sys.stderr if self.json else sys.stdout) as bars:
                report = learn_scene(self.store, scene, options, bars)
        except KeyboardInterrupt:
            print("stopped; the same command continues where it stopped", file=sys.stderr)
            return 130
        if self.calibration is not None and report.hand_eye is not None:
            write_hand_eye(report, scene.train[0].camera, self.calibration)
        if self.json:
            print_json(dataclasses.asdict(report))
            return 0
        for line in _told(report):
            print(line)
        if scene.test:
            print_next("evercal", "evaluate", self.store, self._scene_word(scene.name))
        else:
            print_next("evercal", "localize", self.store, "IMAGE")
        return 0

    def _refuse_hand_eye(self, scene: str) -> None:
        for option, value in (
            ("--gripper-from-camera", self.gripper_from_camera),
            ("--calibration", self.calibration),
        ):
            if value is not None:
                raise InputError(
                    f"{option} {value}: {scene} states camera poses, so there is no camera to find"
                    " on a gripper; leave the option out"
                )

    def _scene_word(self, name: str) -> str:
        return str(self.scene) if self.name is None else f"{name}={self.scene}"

    def _options(self) -> "LearnOptions":
        from evercal.continual.learn_scene import LearnOptions
        from evercal.continual.presets import preset, short_side
        from evercal.continual.strategies import strategy_named

        if self.encoder is not None and not self.encoder.is_file():
            raise InputError(f"--encoder {self.encoder}: no such file")
        stage = memory_budget.with_memory(preset(self.preset, self.seed), self.memory)
        if self.centres is not None:
            head = dataclasses.replace(stage.head, centres_per_scene=self.centres)
            stage = dataclasses.replace(stage, head=head)
        strategy = strategy_named(self._strategy())
        if self.centres is not None and strategy.method is None:
            raise InputError(
                f"--centres {self.centres}: strategy {strategy.name} trains no network; leave the"
                " option out"
            )
        rough = None
        if self.gripper_from_camera is not None:
            from evercal.calibration.calibration import read_transform

            rough = read_transform(self.gripper_from_camera)
        side = short_side(self.preset)
        return LearnOptions(stage, strategy, self.encoder, side, rough, self.device)

    def _strategy(self) -> str:
        """The strategy asked for, else the store's; refuses what a store cannot change later."""
        from evercal.continual.strategies import STRATEGIES, strategy_named
        from evercal.mapping.store import Store
        from evercal.storage import MANIFEST

        if self.strategy is not None:
            usable = [name for name, entry in STRATEGIES.items() if not entry.jointly]
            if self.strategy in STRATEGIES and self.strategy not in usable:
                raise InputError(
                    f"--strategy {self.strategy}: needs the recordings of all scenes at once, so it"
                    f" is for the benchmark only; use one of {', '.join(usable)}"
                )
            if self.strategy not in usable:
                raise InputError(f"--strategy {self.strategy}: unknown; use {', '.join(usable)}")
        if not (self.store / MANIFEST).exists():
            return self.strategy or "evercal"
        maps = Store.open(self.store).maps
        method = strategy_named(maps.strategy).method
        if self.encoder is not None:
            raise InputError(
                f"--encoder {self.encoder}: {self.store} keeps the encoder it was made with; leave"
                f" the option out or start a new store"
            )
        made_with = maps.heads[-1].options.centres_per_scene if maps.heads else self.centres
        shared = method is not None and not method.head_per_scene
        if shared and self.centres is not None and self.centres != made_with:
            raise InputError(
                f"--centres {self.centres}: {self.store} was made with {made_with} for each scene;"
                f" leave the option out or start a new store"
            )
        return self.strategy or maps.strategy


def _told(report: "LearnReport") -> list[str]:
    """What came out, in sentences."""
    steps = f" and {report.iterations} steps" if report.iterations else ""
    lines = [
        f"{report.scene}: learned in {report.seconds:.0f} s{steps}; {report.frames_kept} keyframes"
        f" with {report.landmarks} landmarks; all scenes take {size(report.memory_bytes)}"
        + (f", the network {size(report.head_bytes)}" if report.head_bytes else "")
    ]
    if report.hand_eye is not None:
        lines += hand_eye_lines(report.hand_eye)
    if report.adjusted is not None:
        lines += adjusted_lines(report.adjusted)
    else:
        share = f"{100 * report.inlier_threshold:.0f} %"
        lines.append(f"poses with fewer than {share} inliers are reported as unknown_scene")
    return lines


def hand_eye_lines(found: "HandEyeReport") -> list[str]:
    """Where the camera was found on the gripper, in sentences."""
    import numpy as np

    from evercal.geometry import axis_deviation

    sigma, turn = axis_deviation(np.array(found.covariance))
    x, y, z = (1000 * value for value in found.translation_m)
    lines = [
        f"gripper_from_camera: ({x:.1f}, {y:.1f}, {z:.1f}) mm, quaternion wxyz"
        f" ({', '.join(f'{value:.5f}' for value in found.quaternion_wxyz)}); standard deviation"
        f" {sigma:.2f} mm and {turn:.3f} deg per axis; {found.pairs} of {found.of_pairs} pairs of"
        " images agree with it"
    ]
    lines += [f"do not rely on it: {doubt}" for doubt in found.doubts]
    if found.given_mm is not None:
        lines.append(
            f"it lies {found.given_mm:.1f} mm and {found.given_deg:.1f} deg from the one given"
        )
    return lines


def write_hand_eye(report: "LearnReport", camera: "Camera", path: Path) -> None:
    """Writes the `gripper_from_camera` of a learned recording as a calibration file."""
    from datetime import UTC, datetime

    import numpy as np

    from evercal.calibration.calibration import Calibration
    from evercal.calibration.verdict import verdict

    found = report.hand_eye
    assert found is not None, "the recording states gripper poses only"
    made = Calibration(
        "eye_in_hand",
        found.gripper_from_camera,
        np.array(found.covariance),
        parent_frame="gripper",
        camera=camera,
        source={"command": "learn", "scene": report.scene, "frames": report.train_frames},
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    told = [f"Do not rely on it: {doubt}." for doubt in found.doubts] or [verdict(made)]
    dataclasses.replace(made, verdict=" ".join(told)).write(path)


def adjusted_lines(adjusted: "Adjusted") -> list[str]:
    """What bundle adjustment changed about a recording, in sentences."""
    shift = sum(x * x for x in adjusted.common_translation_mm) ** 0.5
    turn = sum(x * x for x in adjusted.common_rotation_deg) ** 0.5
    lines = [
        f"bundle adjustment: median reprojection error {adjusted.residual_px:.2f} px; stated poses"
        f" are good to {adjusted.pose_sigma_mm:.1f} mm and {adjusted.pose_sigma_deg:.2f} deg per"
        f" axis; common transform corrected by {shift:.1f} mm and {turn:.2f} deg; focal length by"
        f" {adjusted.focal_percent:+.2f} %"
    ]
    if abs(adjusted.time_shift_frames) > 0.02:
        lines.append(
            f"the images were taken {adjusted.time_shift_frames:+.2f} frame intervals after their"
            " stated poses: check the clocks"
        )
    if adjusted.wrong_poses:
        lines.append(
            f"stated poses that contradict the images: {_few(adjusted.wrong_poses)}; left out"
        )
    if adjusted.doubtful_poses:
        lines.append(f"stated poses that were given less weight: {_few(adjusted.doubtful_poses)}")
    return lines


def _few(names: tuple[str, ...], most: int = 8) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def parse_memory(text: str) -> tuple[float | None, int | None]:
    """The share or the bytes that --memory names; see `memory_budget.parse_memory`.

    Raises:
        InputError: Neither, or nothing at all to keep keyframes in.
    """
    try:
        return memory_budget.parse_memory(text)
    except InputError as error:
        raise InputError(f"--{error}") from None


def check_name(name: str) -> None:
    """Refuses scene names that are no single word of a path or clash with NAME=SCENE.

    Raises:
        InputError: Such a name.
    """
    if not name.strip() or name.startswith(".") or re.search(r"[/\\=\x00-\x1f]", name):
        raise InputError(
            f"scene name {name!r}: give one with --name that is not empty, does not begin with a"
            f" dot and holds no slash, '=' or line break"
        )
