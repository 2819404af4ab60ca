"""Formats of recordings, and options that are out of range."""

from typing import get_args

import pytest

from evercal.choices import FormatName
from evercal.errors import InputError
from evercal.recordings.load import FORMATS
from evercal.recordings.read_options import ReadOptions


def test_names_of_formats_are_known_to_editors() -> None:
    assert get_args(FormatName) == tuple(FORMATS)


@pytest.mark.parametrize("every", [0, -1])
def test_a_step_that_takes_no_image_is_refused(every: int) -> None:
    with pytest.raises(InputError, match=f"`every` {every}: give a number >= 1"):
        ReadOptions(every=every)
