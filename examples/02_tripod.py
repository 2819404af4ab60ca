"""A camera on a tripod, from images of a mapped cell: `base_from_camera`, and whether it moved.

    python examples/02_tripod.py [IMAGES]

IMAGES are of a fixed camera in the cell of 01_wrist.py. The default is packaged, with one image
after the tripod was pushed by 5 mm.
"""

import sys
from pathlib import Path

import evercal
from evercal.recordings.samples import CELL


def main(images: Path) -> None:
    """Write tripod.json and tripod.yml."""
    cell = evercal.Map.open("cell.evercal")
    if not cell.scenes:
        cell.learn(CELL / "wrist")

    names = evercal.FrameNames(base="base_link", camera="tripod_optical")
    tripod = cell.calibrate(images, frames=names)
    print(tripod.meaning)
    print(tripod.verdict)
    tripod.write("tripod.json")
    tripod.export("opencv", "tripod.yml")

    shift = cell.check(CELL / "bumped.jpg", tripod)
    print(f"moved: {shift.moved}, {shift.translation_mm:.1f} mm")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else CELL / "tripod")
