"""One place in two scenes of a map: which base an image is answered in.

Virtual cells are learned twice: with the base moved between, by two robots, with things moved as
well, in one base, and beside a twin that has the same furniture and other things. Images are taken
in the second state and asked for in the second base. Each row is also measured without what
learning knows of places, and where images exclude no scene.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
from numpy.random import Generator, default_rng

from benchmarks.rows import Row, once, save
from evercal import Map
from evercal.classes import frozen
from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.localization import other_bases
from evercal.localization.acceptance import APART_SIGMAS
from evercal.localization.localizer import Localizer
from evercal.recordings import Frame, Recording
from evercal.simulation.box_room import BoxRoom, default_camera, look_at
from evercal.simulation.cell_room import WORK_AREA_M, cell_room

FIRST_SEED = 7100
TRAIN = 24
TEST = 10
NOISE_M = 0.0002
"""Standard deviation of stated positions per axis, metres."""
NOISE_RAD = np.deg2rad(0.02)
THINGS = 72
"""Surfaces of the things on the table: the last ones of a cell."""
FAR_M = 0.003
"""An answer that is farther from the truth, and beyond five deviations, is wrong."""


@frozen
class Case:
    """How the second scene of a cell differs from the first."""

    kind: str
    moved_m: float = 0.0
    """Distance of the second base from the first one."""
    turned_rad: float = 0.0
    things: float = 0.0
    """Share of the things that are elsewhere in the second scene."""
    twin: bool = False
    """Whether the second scene is another cell, with other things."""
    alike: float = 0.0
    """Share of the things that stand in the same place of another room."""


CASES = [
    *(Case("base moved", m) for m in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)),
    *(Case("two robots", 1.0, np.pi / 2) for _ in range(4)),
    *(Case("base and things moved", 0.03, things=share) for share in (0.3, 0.6, 1.0)),
    *(Case("two robots, things moved", 1.0, np.pi, share) for share in (0.3, 0.6)),
    *(Case("twin", 0.02, twin=True) for _ in range(2)),
    *(Case("same base", things=share) for share in (0.0, 0.0, 0.6)),
    *(
        Case("another room, same things", 0.02, alike=share)
        for share in (0.1, 0.2, 0.6)
    ),
]


def run(out: Path = Path("runs/same-place")) -> None:
    """Learn 23 cells twice, and locate ten images of each in the second state.

    Args:
        out: Folder of the rows; complete ones are not repeated.
    """
    rows: list[Row] = []
    for number, case in enumerate(CASES):
        seed = FIRST_SEED + number
        rows += once(out / f"{number:02d}.json", lambda c=case, s=seed: measured(c, s))
    totals: dict[tuple[str, str], Counter[str]] = {}
    for row in rows:
        total = totals.setdefault((str(row["kind"]), str(row["map"])), Counter())
        for name in ("cells", *OUTCOMES):
            total[name] += int(row[name])
    table = []
    for (kind, name), total in totals.items():
        table.append({"cell": kind, "map": name, **total})
    save(out / "same-place.csv", table, {"first_seed": FIRST_SEED, "images": TEST})


OUTCOMES = ("right", "ambiguous", "refused", "wrong")


def measured(case: Case, seed: int) -> list[Row]:
    """Outcomes of one cell, with places and without."""
    rng = default_rng([seed, 71])
    first = cell_room(seed)
    second = changed(first, case, rng)
    shift = rng.standard_normal(3)
    shift *= case.moved_m / max(float(np.linalg.norm(shift)), 1e-9)
    second_from_first = SE3.exp([*shift, 0, 0, case.turned_rad])
    with TemporaryDirectory() as folder:
        cell = Map.open(Path(folder) / "map")
        cell.learn(recorded("first", first, SE3.identity(), rng))
        recording = recorded("second", second, second_from_first, rng)
        cell.learn(recording)
        scenes = [replace(s, places={}) for s in cell.localizer.contents.scenes]
        without = replace(cell.localizer.contents, scenes=scenes)
        rows = []
        for name, localizer in (
            ("with places", cell.localizer),
            ("without", Localizer(without)),
        ):
            counts = Counter(outcome(localizer, frame) for frame in recording.test)
            row: Row = {"kind": case.kind, "seed": seed, "map": name, "cells": 1}
            rows.append(row | {key: counts[key] for key in OUTCOMES})
        with patch.object(other_bases, "FAR_BETTER", 0.0):
            counts = Counter(outcome(cell.localizer, frame) for frame in recording.test)
        row = {"kind": case.kind, "seed": seed, "map": "no exclusion", "cells": 1}
        rows.append(row | {key: counts[key] for key in OUTCOMES})
    return rows


def outcome(localizer: Localizer, frame: Frame) -> str:
    """How an image is answered."""
    estimate = localizer.localize(frame.read_image(), frame.camera)
    pose = estimate.uncertain_pose
    truth = frame.base_from_camera
    if pose is None or truth is None:
        return "ambiguous" if estimate.status == "ambiguous" else "refused"
    metres, _ = pose_distance(pose.pose, truth)
    beyond = UncertainPose.squared_mahalanobis(pose, truth) > APART_SIGMAS**2
    return "wrong" if metres > FAR_M and beyond else "right"


def changed(room: BoxRoom, case: Case, rng: Generator) -> BoxRoom:
    """The cell in its second state."""
    other = BoxRoom.__new__(BoxRoom)
    vars(other).update(vars(room))
    things = room.surfaces[-THINGS:]
    around = room.surfaces[:-THINGS]
    if case.alike:
        another = cell_room(room.seed + 500).surfaces
        around = another[:-THINGS]
        same = int(case.alike * THINGS / 6) * 6
        things = [*things[:same], *another[-THINGS:][same:]]
    if case.twin:
        things = cell_room(room.seed + 500).surfaces[-THINGS:]
    moved = []
    for box in range(0, THINGS, 6):
        shift = np.zeros(3)
        if rng.random() < case.things:
            shift[:2] = rng.uniform(-0.15, 0.15, 2)
        for surface in things[box : box + 6]:
            moved.append(replace(surface, corner_m=surface.corner_m + shift))
    other.surfaces = [*around, *moved]
    return other


def recorded(
    name: str, room: BoxRoom, base_from_room: SE3, rng: Generator
) -> Recording:
    """Images around the work area, with noisy poses in a base; those of tests are exact."""
    camera = default_camera()
    frames = []
    for number in range(TRAIN + TEST):
        pose = _view(rng)
        image = room.render(camera, pose)
        noise = np.zeros(6)
        if number < TRAIN:
            noise = rng.standard_normal(6) * np.repeat([NOISE_M, NOISE_RAD], 3)
        stated = base_from_room @ pose @ SE3.exp(noise)
        frames.append(Frame(f"{number:04d}", image, camera, stated))
    return Recording(name, tuple(frames[:TRAIN]), tuple(frames[TRAIN:]))


def _view(rng: Generator) -> SE3:
    """A camera that looks at the work area from 0.35 to 0.8 m."""
    heading = rng.uniform(0, 2 * np.pi)
    height = rng.uniform(0.5, 1.2)
    flat = np.cos(height)
    away = np.array([flat * np.cos(heading), flat * np.sin(heading), np.sin(height)])
    target = WORK_AREA_M + rng.uniform(-0.08, 0.08, 3)
    eye = target + rng.uniform(0.35, 0.8) * away
    return look_at(eye, target, rng.uniform(-0.4, 0.4))
