"""A folder of results remembers what it was begun with."""

import json
from collections.abc import Mapping
from pathlib import Path

from evercal.errors import InputError
from evercal.storage.atomic import write_json


def lock_settings(path: Path, settings: Mapping[str, object]) -> None:
    """Notes the settings of a run that may be taken up again, or refuses to mix it with another.

    Args:
        path: file in the folder of results; folder and file are made where they are missing.
        settings: whatever decides the results, as JSON knows it; compared key by key.

    Raises:
        InputError: the file holds other settings, or none that can be read.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, settings)
    before = read_settings(path)
    now = json.loads(json.dumps(settings))
    for key in sorted({*before, *now}):
        a, b = before.get(key), now.get(key)
        if a != b:
            raise InputError(
                f"{path.parent}: was begun with other settings: {key} {a!r}, now it is {b!r}; "
                f"give another --out or the same settings"
            )


def read_settings(path: Path) -> dict[str, object]:
    """What `lock_settings` wrote.

    Raises:
        InputError: there is none that can be read.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError
    except (OSError, ValueError):
        raise InputError(f"{path}: no settings in JSON; remove the folder and start anew") from None
    return found
