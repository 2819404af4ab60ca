"""x."""

from pathlib import Path

from evercal.datasets.frame import Scene
from evercal.datasets.read_options import ReadOptions

USES = ()


def detect(root: Path) -> bool:
    return False


def load(root: Path, options: ReadOptions) -> Scene:
    raise NotImplementedError
