"""What methods are measured against: no protection at all, and nothing shared."""

from dataclasses import dataclass
from typing import ClassVar

from evercal.continual.methods.method import Method


@dataclass(frozen=True)
class FineTuning(Method):
    """Trains on each new scene from where the last one ended."""

    citation: ClassVar[str] = "control: the same head and steps, no replay"


@dataclass(frozen=True)
class Isolation(Method):
    """A head for each scene, started from the last one: nothing to forget, nothing shared."""

    citation: ClassVar[str] = "after ESAC (Brachmann and Rother, ICCV 2019): an expert per scene"
    head_per_scene: ClassVar[bool] = True
