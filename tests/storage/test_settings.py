"""Settings of a run, stored in its folder of results."""

from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.storage.settings import lock_settings


def test_other_settings_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "new" / "settings.json"
    settings = {"steps": 3, "sizes": (1, 2)}
    for _ in range(2):  # tuples come back as lists
        lock_settings(file, settings)
    before = file.read_bytes()
    for other, message in (
        ({**settings, "steps": 4}, "new: .*steps 3, now it is 4; give another `out`"),
        ({"steps": 3}, r"sizes \[1, 2\], now it is None"),
        ({**settings, "seed": 0}, "seed None, now it is 0"),
    ):
        with pytest.raises(InputError, match=message):
            lock_settings(file, other)
    assert file.read_bytes() == before


@pytest.mark.parametrize("text", ["{", "[1]", "[]", "[[1, 2]]", "null", "3"])
def test_settings_that_cannot_be_read_are_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "settings.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"settings\.json: no settings in JSON"):
        lock_settings(file, {})
    assert file.read_text() == text
