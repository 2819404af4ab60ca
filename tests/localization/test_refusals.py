"""What a localizer refuses: devices it has not, poses that no landmark supports."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.localization.localizer import LocalizeOptions, Localizer
from evercal.localization.query import Hypothesis


@pytest.mark.parametrize("device", ["cuda", "mps", ""])
def test_other_devices_are_refused(tmp_path: Path, device: str) -> None:
    with pytest.raises(InputError, match=f"device '{device}'"):
        Localizer.open(tmp_path, device=device)


@dataclass
class Record:
    """The thresholds of a scene."""

    min_support: float
    inlier_threshold: float
    name: str = "kitchen"


@pytest.mark.parametrize("record", [Record(1.5, 0.0), Record(0.0, 0.0)])
def test_a_pose_without_landmarks_is_no_answer_of_a_map(record: Record) -> None:
    localizer: Any = Localizer.__new__(Localizer)
    localizer.maps, localizer.options = SimpleNamespace(scenes=[record]), LocalizeOptions()
    found = Hypothesis(0, SE3.identity(), aligned=True)
    assert found.support == 0
    assert localizer._accepted(found) is False
