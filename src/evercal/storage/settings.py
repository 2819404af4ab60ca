"""Settings of a run, stored in its folder of results."""

import json
from pathlib import Path

from evercal.errors import InputError
from evercal.storage.atomic import write_json
from evercal.typing import JsonObject, Record


def lock_settings(path: Path, settings: Record) -> None:
    """Store the settings of a run that can be resumed; refuse a folder with other settings.

    The file is created if it is missing. Settings are JSON values, compared key by key.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, settings)
    before = read_settings(path)
    now = json.loads(json.dumps(settings))
    for key in sorted({*before, *now}):
        old = before.get(key)
        new = now.get(key)
        if old != new:
            raise InputError(
                f"{path.parent}: was begun with other settings: {key} {old!r}, now it is {new!r};"
                f" give another `out` or the same settings"
            )


def read_settings(path: Path) -> JsonObject:
    """Read the settings that `lock_settings` stored."""
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(settings, dict):
            raise ValueError
    except (OSError, ValueError):
        raise InputError(
            f"{path}: no settings in JSON; remove the folder and restart"
        ) from None
    return settings
