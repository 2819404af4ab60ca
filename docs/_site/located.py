"""Draw README's picture, a located image: python docs/_site/located.py cell.evercal IMAGE.

The map is that of examples/01_wrist.py, the image samples/cell/tripod/0004.jpg.
"""

import sys
from pathlib import Path

import evercal
from evercal.recordings import write_image
from evercal.reports.answers import Answer
from evercal.reports.video import animate

OUT = Path(__file__).parents[1] / "located.jpg"


def main(store: Path, image: Path) -> None:
    """Locate an image and write a frame of `evercal localize --video`."""
    localizer = evercal.Map.open(store).localizer
    estimate = localizer.localize(evercal.read_image(image))
    answer = Answer(image, estimate, estimate.milliseconds)
    [frame] = animate([answer], localizer, evercal.read_image)
    write_image(OUT, frame)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
