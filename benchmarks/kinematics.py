"""Poses of links by `RobotModel`, beside those of pin and urchin (install both: no extra)."""

import importlib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import Positional

from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.robot.robot_model import RobotModel
from evercal.typing import Array

SETS = 20
"""Random joint values of each robot."""


def by_pin(path: Path, links: list[str], values: dict[str, Array]) -> list[Array]:
    """(SETS, 4, 4) poses of each link in the root."""
    pin: Any = importlib.import_module("pinocchio")
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    data = model.createData()
    poses = np.zeros((len(links), SETS, 4, 4))
    for k in range(SETS):
        q = np.zeros(model.nq)
        for name, joint in zip(model.names, model.joints, strict=True):
            if joint.nq and name in values:
                value = values[name][k]
                whole = [np.cos(value), np.sin(value)]
                q[joint.idx_q : joint.idx_q + joint.nq] = (
                    whole if joint.nq == 2 else value
                )
        pin.framesForwardKinematics(model, data, q)
        for i, link in enumerate(links):
            frame = model.getFrameId(link, pin.FrameType.BODY)
            poses[i, k] = data.oMf[frame].homogeneous
    return list(poses)


def by_urchin(path: Path, links: list[str], values: dict[str, Array]) -> list[Array]:
    """As `by_pin`."""
    robot = importlib.import_module("urchin").URDF.load(
        str(path), lazy_load_meshes=True
    )
    known = {name: rows for name, rows in values.items() if name in robot.joint_map}
    poses = robot.link_fk_batch(cfgs=known, links=links, use_names=True)
    return [poses[link] for link in links]


def run(files: Annotated[tuple[Path, ...], Positional]) -> None:
    """Print the largest difference over all links, at random joint values."""
    print("| URDF | links | joint values | pin | urchin |\n|---|---:|---:|---|---|")
    for path in files:
        try:
            model = RobotModel(path)
            arms = {link: model.arm(model.base_link, link) for link in model.links}
        except InputError as error:
            print(
                f"| {path.name} | refused: {str(error).removeprefix(f'{path}: ')} |||"
            )
            continue
        rng = np.random.default_rng(len(arms))
        values = dict[str, Array]()
        for arm in arms.values():
            for name in arm.joints:
                values[name] = rng.uniform(-2, 2, SETS)
        cells = []
        for reader in (by_pin, by_urchin):
            try:
                others = reader(path, list(arms), values)
            except Exception as error:  # whatever another reader raises is its answer
                cells.append(
                    f"{type(error).__name__}: {str(error).splitlines()[0][:60]}"
                )
                continue
            off = []
            for arm, other in zip(arms.values(), others, strict=True):
                mine = (
                    np.array([values[name] for name in arm.joints]).reshape(-1, SETS).T
                )
                off.append(pose_distance(arm.poses(mine), SE3.from_matrix(other)))
            metres, radians = np.max(off, axis=(0, 2))
            cells.append(f"{1000 * metres:.0e} mm, {np.rad2deg(radians):.0e} deg")
        print(f"| {path.name} | {len(arms)} | {len(values)} | {' | '.join(cells)} |")
