"""Paths of output files, checked before the work begins."""

import os
from pathlib import Path

from evercal.errors import InputError


def check_output(file: Path, option: str) -> None:
    """Check that a file can be created or replaced.

    Args:
        file: Path of the file.
        option: Name of the option, for the message.

    Raises:
        InputError: The folder is missing or read-only, or the path is a folder.
    """
    folder = file.absolute().parent
    if not folder.is_dir():
        raise InputError(f"{option} {file}: folder {folder} does not exist; create it first")
    if file.is_dir():
        raise InputError(f"{option} {file}: it is a folder; give the path of a file")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{option} {file}: no permission to write to {folder}")
