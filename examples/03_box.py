"""A camera beside the robot, by a box that the gripper holds: no map, no board.

    python examples/03_box.py [RECORDING]

RECORDING has images of the fixed camera and the gripper pose of each. By default, a virtual arm
turns a box before a virtual camera, whose pose is in box/truth.json.
"""

import sys
from pathlib import Path

import evercal
from evercal.simulation.cell_recording import record_cell


def main(recording: Path) -> None:
    """Write tripod.json."""
    if recording == Path("box/held") and not recording.exists():
        list(record_cell(Path("box"), wrist_images=1))

    things = evercal.Map.open("things.evercal")
    tripod = things.eye_to_hand(recording)
    print(tripod.meaning)
    print(tripod.parent_from_child.matrix())
    print(tripod.verdict)
    tripod.write("tripod.json")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "box/held"))
