"""Hand-eye calibration where the stated poses of an arm err together: errors, sigma, time."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm
from tyro.conf import arg

from benchmarks.hand_eye import Setting, pose, recording, rotations
from benchmarks.pair_answers import Recording, answers
from benchmarks.real_halves import boards, evidence, halves
from benchmarks.rows import Row, median_of, numbers, once, save
from benchmarks.same_answers import ROOT, source_of
from evercal.evaluation.metrics import share_inside
from evercal.geometry import SE3
from evercal.robot.arm import Arm, MovingJoint
from evercal.robot.known_arms import known_arm
from evercal.robot.mount import MountName
from evercal.robot.pose_errors import ArmErrors, SharedErrors, shared_errors

ARMS = (
    "ur5e",
    "panda",
    "iiwa14",
    "kr6-r900-2",
    "irb120",
    "xarm6",
    "scara",
    "so101",
)
"""Arms of the table; `scara` is its SCARA with two more joints of a wrist, because a gripper that
turns about one axis only determines no mount."""
TARGETS = {"board": (0.1, 0.01), "held thing": (0.2, 0.05), "wrist map": (0.5, 0.03)}
"""Noise per axis of camera poses, mm and deg: about the target, of a map about the camera."""
SMOOTH = {
    "smooth translation": 2.5e-4,
    "smooth rotation": np.deg2rad(0.06),
    "drift translation": 1.5e-4,
    "drift rotation": np.deg2rad(0.03),
}
"""Sizes of errors as in real recordings, metres and radians."""
LEFT_OUT = ("joint offsets", "smooth", "drift", "_PSEUDO", "_AT_ZERO")
"""Kinds of errors, and constants of `noise_levels`, that rows leave out."""
SOLVE = "evercal.calibration.pose_pairs.shared.shared_errors"
COLUMNS = ("arm", "errors", "deg", "poses", "mount", "target", "known")
LEVELS = "evercal.calibration.pose_pairs.noise_levels."


@dataclass(frozen=True)
class Condition:
    """One kind of recording."""

    arm: str = "panda"
    errors: str = "joints"
    """`joints`, with links off by 0.2 mm; `exact links`; `smooth`; independent noise of `camera`,
    `robot` or `both`."""
    deg: float = 0.2
    """Standard deviation of joint offsets; millimetres of a sliding joint."""
    poses: int = 25
    mount: MountName = "eye_in_hand"
    target: str = "board"


def arm_named(name: str) -> Arm:
    """An arm of the table, or the SCARA with a wrist."""
    if name != "scara":
        return known_arm(name)
    arm = known_arm("hsr065")
    tilt = MovingJoint(arm.last, np.eye(3)[0], True, 4)
    roll = MovingJoint(np.eye(4), np.eye(3)[2], True, 5)
    ranges = np.concatenate([arm.ranges, [[-2, 0, 2], [-6, 0, 6]]])
    joints = (*arm.joints, "5", "6")
    return Arm(joints, (*arm.chain, tilt, roll), np.eye(4), ranges, "scara")


def drawn(condition: Condition, seed: int) -> Recording:
    """Draw one recording."""
    if condition.errors in ("camera", "robot", "both"):
        setting = Setting(condition.mount, condition.poses, "table", condition.errors)
        if condition.errors == "both":
            setting = replace(setting, noise_mm=0.1, noise_deg=0.04)
        simple = recording(setting, seed)
        robot = simple.pairs.base_from_gripper
        camera = simple.pairs.camera_from_board
        return _recording(robot, camera, condition.mount, simple.parent_from_camera)
    rng = np.random.default_rng(seed)
    arm = arm_named(condition.arm)
    distance_m = 0.25 if condition.arm == "so101" else 0.5
    tilt = Rotation.from_rotvec(rng.normal(0, 0.26, 3))
    in_gripper = pose(tilt, rng.normal(0, 0.05, 3))
    at_rest = arm.poses(arm.ranges[None, :, 1])[0]
    ahead = at_rest.apply(np.array([0, 0, distance_m]))
    values = _postures(arm, in_gripper, ahead, condition.poses, rng)
    rotates = arm.rotates()
    unit = np.where(rotates, np.deg2rad(1), 1e-3)
    bent = arm if condition.errors == "exact links" else _true(arm, rng)
    true = bent.poses(values)
    # Offsets of the first and the last joint look like those of base and mount.
    off = unit * rng.normal(0, condition.deg, len(unit))
    off[[0, -1]] = 0
    if condition.errors == "smooth":
        stated = true @ SE3.exp(_smooth(true, rng))
    else:
        scatter = unit * rng.normal(0, 0.01, values.shape)
        stated = arm.poses(values - off + scatter)
    elsewhere = pose(Rotation.random(rng=rng), ahead)
    if condition.mount == "eye_to_hand":  # the camera looks back at the gripper
        back = rotations(at_rest) * Rotation.from_euler("x", np.pi)
        elsewhere = pose(back, ahead)
    if condition.mount == "eye_in_hand":
        camera = in_gripper.inverse() @ true.inverse() @ elsewhere
        truth = in_gripper
    else:
        camera = elsewhere.inverse() @ true @ in_gripper
        truth = elsewhere
    mm, deg = TARGETS[condition.target]
    noise = rng.normal(0, np.repeat([mm / 1000, np.deg2rad(deg)], 3), (len(true), 6))
    noise = SE3.exp(noise)
    camera = noise @ camera if condition.target == "wrist map" else camera @ noise
    return _recording(stated, camera, condition.mount, truth)


def _recording(robot: SE3, camera: SE3, mount: str, truth: SE3) -> Recording:
    matrices = {"robot": robot, "camera": camera, "truth": truth}
    values = {name: pose.matrix().tolist() for name, pose in matrices.items()}
    return {**values, "mount": mount}


def _postures(
    arm: Arm, in_gripper: SE3, ahead: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    """(n, k) joint values at which the camera looks at a point, or a board faces it."""
    low, usual, high = arm.ranges.T
    spread = np.where(arm.rotates(), 0.3, 0.05)
    spread[-3:] += 0.1 * arm.rotates()[-3:]
    distance_m = np.linalg.norm(ahead - arm.poses(usual[None])[0].translation_m)
    chosen = np.zeros((0, len(usual)))
    while len(chosen) < count:
        values = np.clip(rng.normal(usual, spread, (400, len(usual))), low, high)
        seen = (arm.poses(values) @ in_gripper).inverse().apply(ahead[None])
        seen = seen.reshape(-1, 3)
        away = np.linalg.norm(seen, axis=1)
        near = np.abs(away / distance_m - 1.2) < 0.6
        chosen = np.concatenate(
            [chosen, values[near & (seen[:, 2] > np.cos(0.45) * away)]]
        )
    return chosen[:count]


def _true(arm: Arm, rng: np.random.Generator) -> Arm:
    """The arm with inner links off by 0.2 mm."""
    chain = [arm.chain[0]]
    for joint in arm.chain[1:]:
        before = joint.before.copy()
        before[:3, 3] += rng.normal(0, 2e-4, 3)
        chain.append(joint._replace(before=before))
    return replace(arm, chain=tuple(chain))


def _smooth(poses: SE3, rng: np.random.Generator) -> np.ndarray:
    kinds = shared_errors(poses, ArmErrors())
    errors = np.zeros((len(poses), 6))
    for name, size in SMOOTH.items():
        slopes = kinds[name].slopes
        errors += slopes @ rng.normal(0, size, slopes.shape[2])
    return errors


def knowledge(name: str, condition: Condition) -> ArmErrors:
    """What `solve` is told of the arm."""
    if name == "independent":
        return ArmErrors(accuracy_rad=1e-6)
    if not name.startswith("named"):
        return ArmErrors()
    factor = {"named, half": 0.5, "named, twice": 2.0}.get(name, 1.0)
    return ArmErrors(arm_named(condition.arm), factor * np.deg2rad(condition.deg))


def measured(name: str, condition: Condition, count: int, before: Path) -> list[Row]:
    """Errors of the answers to many recordings, with some knowledge of the arm."""
    recordings = [drawn(condition, seed) for seed in range(count)]
    if name == "before":
        file = before.with_name("recordings.json")
        file.write_text(json.dumps(recordings))
        module = Path(__file__).with_name("pair_answers.py")
        environment = {**os.environ, "PYTHONPATH": str(before / "src")}
        command = [sys.executable, str(module), str(file)]
        return json.loads(subprocess.check_output(command, env=environment))
    with ExitStack() as changed:
        left_out = name.removeprefix("without ")
        if left_out.startswith("_"):
            changed.enter_context(patch(LEVELS + left_out, 0.0))
        elif left_out != name:
            changed.enter_context(patch(SOLVE, _others(left_out)))
        return answers(recordings, {"errors": knowledge(name, condition)})


def _others(left_out: str) -> Any:
    """`shared_errors` without some kinds."""

    def some(poses: SE3, errors: ArmErrors) -> dict[str, SharedErrors]:
        kinds = shared_errors(poses, errors)
        return {name: kinds[name] for name in kinds if not name.startswith(left_out)}

    return some


Cell = tuple[Condition, tuple[str, ...]]
"""A condition, and what is known."""


def parts() -> dict[str, list[Cell]]:
    """The cells of each part."""
    known = ("before", "unnamed", "named")
    base = [Condition(name) for name in ARMS]
    offset = [replace(c, deg=deg) for deg in (0.05, 0.2, 1.0) for c in base]
    many = [replace(c, poses=n) for n in (25, 8, 15, 60) for c in offset]
    other = [replace(c, mount="eye_to_hand") for c in base]
    other += [replace(c, errors="exact links") for c in base]
    other += [replace(c, target=t) for t in list(TARGETS)[1:] for c in base]
    smooth = [replace(c, errors="smooth", deg=0.0) for c in base]
    smooth = [replace(c, poses=n) for n in (25, 8, 15, 60) for c in smooth]
    own: list[Condition] = []
    for mount in ("eye_in_hand", "eye_to_hand"):
        for who in ("camera", "robot"):
            own += [Condition("any", who, 0.0, n, mount) for n in (8, 25)]
    few = [Condition("any", "both", 0.0, n) for n in (5, 6, 8, 10, 20)]
    without = ("unnamed", "independent", *(f"without {kind}" for kind in LEFT_OUT))
    kinds = [*base, *smooth[: len(base)]]
    return {
        "offsets": [(c, known) for c in many],
        "mounts": [(c, known) for c in other],
        "priors": [(c, ("named, half", "named, twice")) for c in offset],
        "smooth": [(c, ("before", "independent", "unnamed")) for c in smooth],
        "independent": [(c, ("before", "unnamed")) for c in own],
        "few": [(c, ("before", "unnamed")) for c in few],
        "kinds": [(c, without) for c in kinds],
    }


def summary(rows: list[Row]) -> Row:
    """Medians and shares of many answers."""
    good = [row for row in rows if "d2" in row]
    values = {key: numbers(good, key) for key in (good or [{}])[0]}
    if not values:
        return {"draws": len(rows), "refused": len(rows)}
    medians = {f"median {key}": median_of(values[key]) for key in ("mm", "deg")}
    d2 = values["d2"]
    return {
        "draws": len(rows),
        "refused": len(rows) - len(good),
        **medians,
        "mean d2": float(d2.mean()),
        "inside 95": share_inside(d2.tolist()),
        "d2 above 40": int((d2 > 40).sum()),
        "sigma mm": median_of(values["sigma mm"]),
        "sigma deg": median_of(values["sigma deg"]),
        "median ms": median_of(values["ms"]),
    }


def _rows(
    part: str, cells: list[Cell], count: int, out: Path, before: Path
) -> Iterator[tuple[str, list[Row]]]:
    """Label and answers of each row, over all arms and for each."""
    pooled: dict[str, list[Row]] = {}
    for condition, names in tqdm(cells, desc=part):
        for name in names:
            values = (*vars(condition).values(), name)
            label = " | ".join(map(str, values))
            file = out / f"{label.replace(' | ', '-')}-{count}.json"
            answered = partial(measured, name, condition, count, before)
            rows = once(file, answered)
            everyone = " | ".join(map(str, ("all", *values[1:])))
            pooled.setdefault(everyone, []).extend(rows)
            pooled[label] = rows
    yield from pooled.items()


def run(
    part: str = "all",
    count: Annotated[int, arg(name="trials")] = 4,
    reference: str = "46c21235",
    out: Path = Path("runs/shared-errors"),
    real: Path | None = None,
) -> None:
    """Solve simulated pose pairs of arms whose poses err together.

    Args:
        part: `offsets`, `mounts`, `priors`, `smooth`, `independent`, `few`, `kinds` or `all`.
        count: Recordings of each arm and condition; 25 times as many without an arm.
        reference: Commit whose answers stand as `before`.
        out: Folder of the answers, which are kept, and of the rows.
        real: Folder of real recordings, `handeye` and `abb_fixed`: only their halves are compared.
    """
    before = source_of(reference, out)
    if real is not None:
        boards(real, out)
        command = [sys.executable, "-m", "benchmarks.real_halves", str(real), str(out)]
        environment = {**os.environ, "PYTHONPATH": str(before / "src")}
        old = json.loads(subprocess.check_output(command, env=environment, cwd=ROOT))
        rows = [{"by": reference, **row} for row in old]
        rows += [{"by": "this tree", **row} for row in halves(real, out)]
        save(out / "halves.csv", rows)
        save(out / "evidence.csv", list(evidence(real, out)))
        return
    for name, cells in parts().items():
        if part not in ("all", name):
            continue
        # Few poses cost little, and their shares need many.
        each = 25 * count if name in ("independent", "few") else count
        rows = []
        for label, found in _rows(name, cells, each, out, before):
            words = dict(zip(COLUMNS, label.split(" | "), strict=True))
            if len(found) and words["arm"] in ("all", *ARMS):
                rows.append({**words, **summary(found)})
        save(out / f"{name}.csv", rows, {"trials": each, "before": reference})
