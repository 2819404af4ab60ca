"""The whole chain in virtual cells: record, learn, calibrate a tripod, compare with the truth."""

import tempfile
from pathlib import Path

import pandas as pd

from benchmarks.rows import save, show
from evercal.geometry import pose_distance_mm_deg
from evercal.map import Map
from evercal.simulation.cell_recording import WRIST_IMAGES, record_cell
from evercal.simulation.virtual_cell import CellOptions, VirtualCell


def errors_of(
    seed: int, images: int, options: CellOptions
) -> tuple[float, float, float, float]:
    """Errors of the mount and of the tripod, each in millimetres and degrees."""
    truth = VirtualCell(seed, options).truth
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for _ in record_cell(root / "cell", seed, images, options):
            pass
        learned = Map.open(root / "map")
        report = learned.learn(root / "cell/wrist").hand_eye
        tripod = learned.calibrate(root / "cell/tripod").parent_from_child
    assert report is not None
    mount = report.parent_from_camera.pose
    return (
        *pose_distance_mm_deg(mount, truth.gripper_from_camera),
        *pose_distance_mm_deg(tripod, truth.base_from_tripod),
    )


def run(
    seeds: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10),
    images: int = WRIST_IMAGES,
    size: tuple[int, int] = (640, 480),
    out: Path = Path("runs/virtual-cell.csv"),
) -> None:
    """Measure the errors of every cell, their medians and the largest.

    Args:
        seeds: Seeds of the cells.
        images: Wrist images of each.
        size: Width and height, pixels.
        out: File of the rows.
    """
    options = CellOptions(width=size[0], height=size[1])
    keys = ("mount_mm", "mount_deg", "tripod_mm", "tripod_deg")
    rows = [
        {"cell": seed, **dict(zip(keys, errors_of(seed, images, options), strict=True))}
        for seed in seeds
    ]
    save(out, rows, {"images": images, "size": size})
    show(pd.DataFrame(rows)[list(keys)].agg(["median", "max"]).reset_index())
