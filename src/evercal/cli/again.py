"""A calibration that is made again from what its file records."""

import contextlib
import io
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.calibration.calibration import Calibration

_MAKERS = {"calibrate", "eye-to-hand", "learn", "solve"}
"""Verbs whose command is run again; a file may hold any other words."""


def made_again(file: Path, old: "Calibration") -> str:
    """Make a calibration again with the inputs as they are now, and keep nothing of it.

    Returns:
        What has changed since, and how far the new calibration is from the old one.

    Raises:
        InputError: The file does not record a command that can be run again, or an input is gone.
    """
    from evercal.calibration.learned import calibration_at
    from evercal.cli import parsed
    from evercal.storage.provenance import Made

    made = old.made
    verb: Any = None
    if made and _MAKERS & {*made.command[1:2]}:
        verb = parsed([*map(os.path.expanduser, made.command[1:])])
    if not made or not hasattr(verb, "writes"):
        raise InputError(
            f"{file}: records {made or 'nothing, as files before evercal 0.3'}; make it anew and"
            " give the old file with --against"
        )
    changes = "; ".join(made.changes(Made.of(made.command, verb.given)))
    if "is gone" in changes:
        raise InputError(f"{file}: {changes}; run this in the folder where it was made")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "result")
        written = {**dict.fromkeys(verb.writes), verb.writes[0]: out}
        with contextlib.redirect_stdout(io.StringIO()):
            replace(verb, json=False, **written).run()
        apart = old.distance(calibration_at(out))
    same = changes or "the version and the inputs are the same"
    return (
        f"made again: {same}; it differs by {apart.pose_mm:.3f} mm and {apart.pose_deg:.4f} deg,"
        f" {(apart.d2 / 6) ** 0.5:.1f} sigma"
    )
