"""Settings of a run, stored in its folder of results."""

from pathlib import Path

import pytest

from evercal.errors import InputError
from evercal.storage.settings import lock_settings


def test_other_settings_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "new" / "settings.json"
    lock_settings(file, {"steps": 3, "sizes": (1, 2)})
    before = file.read_bytes()
    lock_settings(file, {"steps": 3, "sizes": (1, 2)})  # tuples come back as lists
    for other, message in (
        (
            {"steps": 4, "sizes": (1, 2)},
            r"new: .*steps 3, now it is 4; give another --out",
        ),
        ({"steps": 3}, r"sizes \[1, 2\], now it is None"),
        ({"steps": 3, "sizes": (1, 2), "seed": 0}, "seed None, now it is 0"),
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
