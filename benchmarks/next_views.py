"""Poses of a wrist recording until a stated accuracy of the mount, by how they are chosen.

Gripper poses are those of the virtual cell's arm, images are replaced by the camera poses that they
would give, with noise from the points that they show. The planner knows a rough mount and one
noise for all views, not the truth. The deviation is that of the best linear estimate at the truth;
`simulated` estimates draws of noise and compares.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from benchmarks.rows import Row, save, show
from evercal.calibration.from_map.next_views import (
    CAMERA_NOISE,
    GRIPPER_NOISE,
    next_views,
    wrist_jacobian,
)
from evercal.geometry import SE3, pose_distance
from evercal.geometry.uncertain_pose import axis_deviation
from evercal.localization.pose_refinement import linearise
from evercal.simulation.box_room import default_camera
from evercal.simulation.cell_room import WORK_AREA_M
from evercal.simulation.virtual_cell import VirtualCell, nominal_mount
from evercal.typing import Array, IntArray

Order = Callable[["Trial"], IntArray]

FIRST = 3
"""Random poses that every order starts with."""
LONGEST = 60
"""Poses after which an order counts as not reaching the accuracy."""
PIXEL_PX = 0.3
"""Standard deviation of a point in an image."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One draw: poses of the arm, the mount, and what is seen."""

    reachable: SE3
    """(n,) base_from_gripper."""
    mount: SE3
    """The true gripper_from_camera."""
    image: Array
    """(n, 6, 6) covariance of the camera pose that an image at each pose gives."""
    rng: np.random.Generator
    start: IntArray
    """(FIRST,) poses that every order starts with."""

    @property
    def weights(self) -> Array:
        """(n, 6, 6) inverse covariance of the residual at each pose."""
        to_camera = self.mount.inverse().adjoint()
        return np.linalg.inv(to_camera @ GRIPPER_NOISE @ to_camera.T + self.image)

    @property
    def added(self) -> Array:
        """(n, 12, 12) information of each pose at the truth."""
        jacobian = wrist_jacobian(self.reachable, self.mount, WORK_AREA_M)
        return np.swapaxes(jacobian, 1, 2) @ self.weights @ jacobian


def trial(seed: int, pool: int) -> Trial:
    """Draw a cell, a mount and a start."""
    rng = np.random.default_rng([seed, 41])
    cell = VirtualCell(seed)
    reachable = cell.reachable_poses(pool)
    mount = cell.truth.gripper_from_camera
    points = WORK_AREA_M + rng.uniform(-1, 1, (80, 3)) * (0.3, 0.4, 0.08)
    image = [CAMERA_NOISE + seen_covariance(pose, points) for pose in reachable @ mount]
    return Trial(
        reachable, mount, np.stack(image), rng, rng.choice(pool, FIRST, replace=False)
    )


def seen_covariance(base_from_camera: SE3, points_m: Array) -> Array:
    """(6, 6) covariance of a camera pose from the points that the camera sees."""
    camera = default_camera(640, 480)
    pixels = camera.project(base_from_camera.inverse().apply(points_m))
    visible = ((pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))).all(1)
    at = base_from_camera.rotation_matrix(), base_from_camera.translation_m
    slopes = linearise(pixels[visible], points_m[visible], *at, camera)[1].reshape(
        6, -1
    )
    return np.linalg.inv(slopes @ slopes.T + 1e-9 * np.eye(6)) * PIXEL_PX**2


def random_order(draw: Trial) -> IntArray:
    """Any pose that was not used."""
    rest = np.setdiff1d(np.arange(len(draw.reachable)), draw.start)
    return np.concatenate([draw.start, draw.rng.permutation(rest)])[:LONGEST]


def farthest_order(draw: Trial) -> IntArray:
    """The pose whose rotation differs most from all used ones."""
    chosen = draw.start.tolist()
    gap = np.full(len(draw.reachable), np.inf)
    while len(chosen) < LONGEST:
        for i in chosen[-1:] if len(chosen) > FIRST else chosen:
            gap = np.minimum(gap, pose_distance(draw.reachable[i], draw.reachable)[1])
        gap[chosen] = -1.0
        chosen.append(int(gap.argmax()))
    return np.array(chosen)


def planned(draw: Trial, mount: SE3 | None) -> IntArray:
    """The poses of `next_views` after the first ones; it knows a rough mount, or none."""
    used = draw.reachable[draw.start]
    chosen = next_views(used, draw.reachable, LONGEST - FIRST, mount)
    return np.concatenate([draw.start, chosen.index])


def covariances(draw: Trial, order: IntArray) -> Array:
    """(n, 6, 6) of gripper_from_camera after each pose, at the truth, without a prior."""
    added = np.cumsum(draw.added[order], 0)
    weak = np.diag([1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4, *np.repeat([1e-4, 1e-6], 3)])
    return np.linalg.inv(added + weak)[:, :6, :6]


def reached(draw: Trial, order: IntArray, sigma_mm: float) -> int:
    """Poses after which the deviation of the position is below a limit."""
    sigmas = [axis_deviation(covariance)[0] for covariance in covariances(draw, order)]
    return next((i + 1 for i, sigma in enumerate(sigmas) if sigma <= sigma_mm), LONGEST)


def simulated_mm(draw: Trial, order: IntArray, draws: int) -> float:
    """Root mean square error of the position per axis, from drawn noise and nonlinear estimates."""
    grippers = draw.reachable[order]
    views = len(order)
    cameras = SE3.from_translation(-WORK_AREA_M) @ grippers @ draw.mount
    roots = np.linalg.cholesky(draw.image[order])
    errors = []
    for _ in range(draws):
        robot = (
            draw.rng.standard_normal((views, 6)) @ np.linalg.cholesky(GRIPPER_NOISE).T
        )
        seen = (roots @ draw.rng.standard_normal((views, 6, 1)))[..., 0]
        stated = grippers @ SE3.exp(robot)
        measured = cameras @ SE3.exp(seen)
        estimate = _estimate(draw.mount, stated, measured, draw.weights[order])
        errors.append(estimate.translation_m - draw.mount.translation_m)
    return 1000 * float(np.sqrt(np.mean(np.square(errors))))


def _estimate(mount: SE3, stated: SE3, measured: SE3, weights: Array) -> SE3:
    """Gauss-Newton from the truth; the weights are those of the model."""
    scene = SE3.from_translation(WORK_AREA_M)
    for _ in range(5):
        residual = ((stated @ mount).inverse() @ scene @ measured).log()
        jacobian = wrist_jacobian(stated, mount, WORK_AREA_M)
        jacobian[:, :, 6:] = measured.inverse().adjoint()
        weighted = np.swapaxes(jacobian, 1, 2) @ weights
        normal = (weighted @ jacobian).sum(0)
        step = -np.linalg.solve(normal, (weighted @ residual[..., None]).sum(0)[:, 0])
        turned = mount.rotation_matrix() @ Rotation.from_rotvec(step[3:6]).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3] = turned
        matrix[:3, 3] = mount.translation_m + step[:3]
        mount = SE3.from_matrix(matrix)
        scene = scene @ SE3.exp(step[6:])
    return mount


ORDERS: dict[str, Order] = {
    "random": random_order,
    "farthest in rotation": farthest_order,
    "next_views": lambda draw: planned(draw, nominal_mount()),
    "next_views, mount unknown": lambda draw: planned(draw, None),
}


def run(
    draws: int = 10,
    pool: int = 200,
    sigmas_mm: tuple[float, ...] = (0.3, 0.2, 0.15),
    noise_draws: int = 20,
    at: int = 15,
    out: Path = Path("runs/next-views.csv"),
) -> None:
    """Count the poses that each order needs.

    Args:
        draws: Cells and mounts.
        pool: Reachable poses.
        sigmas_mm: Standard deviations per axis to reach.
        noise_draws: Draws of noise of the simulated estimates.
        at: Poses of the simulated estimates.
        out: File of the rows: every draw of every order.
    """
    rows: list[Row] = []
    for seed in range(draws):
        draw = trial(seed, pool)
        for name, order in ORDERS.items():
            index = order(draw)
            sigma = axis_deviation(covariances(draw, index)[at - 1])[0]
            counts = {
                f"{limit:g} mm": reached(draw, index, limit) for limit in sigmas_mm
            }
            simulated = simulated_mm(draw, index[:at], noise_draws)
            sigmas = {f"sigma_mm at {at}": sigma, "simulated_mm": simulated}
            rows.append({"order": name, "draw": seed, **counts, **sigmas})
    save(out, rows, {"pool": pool, "at": at})
    medians = (
        pd.DataFrame(rows).drop(columns="draw").groupby("order", sort=False).median()
    )
    show(medians.reset_index())
