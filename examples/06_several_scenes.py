"""Scenes one after another in one map: earlier ones do not change, an image names its own.

python examples/06_several_scenes.py [RECORDING...]
"""

import sys
from pathlib import Path

import evercal
from evercal.recordings.samples import FOLDER, ROOMS


def main(recordings: list[Path]) -> None:
    """Learn scenes, then locate an image of each."""
    rooms = evercal.Map.open("rooms.evercal")
    for path in recordings:
        recording = evercal.load_recording(path)
        report = rooms.learn(recording)
        print(
            f"learned {report.scene}, {report.memory_bytes / 1e6:.1f} MB for all scenes"
        )
        scores = rooms.evaluate(recording).scenes[report.scene]
        print(f"median error {10 * scores.median_translation_cm:.1f} mm")

    for path in recordings:
        image = evercal.load_recording(path).test[0].read_image()
        estimate = rooms.localize(image)
        only = rooms.within(path.name).localize(image)  # where the room is known
        print(f"{path.name}: {estimate.scene}, {estimate.status}, {only.status}")


if __name__ == "__main__":
    main([Path(p) for p in sys.argv[1:]] or [FOLDER / room for room in ROOMS])
