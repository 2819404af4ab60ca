"""Controls: training without protection, and one network per scene."""

from dataclasses import dataclass
from typing import ClassVar

from evercal.continual.methods.method import Method


@dataclass(frozen=True)
class FineTuning(Method):
    """Trains on each new scene from the weights after the last one."""

    citation: ClassVar[str] = "control: the same head and steps, no replay"


@dataclass(frozen=True)
class Isolation(Method):
    """A head per scene, initialised from the last one; scenes share no weights."""

    citation: ClassVar[str] = "after ESAC (Brachmann and Rother, ICCV 2019): an expert per scene"
    head_per_scene: ClassVar[bool] = True
