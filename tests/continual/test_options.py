"""Options out of range are refused where they are made."""

import pytest

from evercal.continual.learning.stage import StageOptions
from evercal.continual.localizer import NetworkLocalizeOptions
from evercal.continual.methods.spdd import SpddOptions
from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.loss import LossOptions
from evercal.continual.networks.trainer import FitOptions
from evercal.errors import InputError


@pytest.mark.parametrize(
    ("options", "field", "value"),
    [
        (EncodePlan, "cells", 0),
        (FitOptions, "batch", 0),
        (FitOptions, "peak_rate", float("nan")),
        (HeadOptions, "width", 0),
        (LossOptions, "clamp_end_px", 0.0),
        (NetworkLocalizeOptions, "candidates", 0),
        (SpddOptions, "metric_weight", -1.0),
        (SpddOptions, "temperature", 0.0),
        (StageOptions, "replay_views_per_frame", 0),
    ],
)
def test_numbers_out_of_range_are_refused(
    options: type, field: str, value: float
) -> None:
    with pytest.raises(InputError, match=rf"{options.__name__}\.{field} is {value}"):
        options(**{field: value})
