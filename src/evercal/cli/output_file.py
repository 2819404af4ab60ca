"""Check of output files before the work starts."""

import os
from pathlib import Path

from evercal.errors import InputError


def require_writable(path: Path) -> None:
    """Check that `--out` names a file in an existing folder with write permission.

    Raises:
        InputError: The folder is missing or not writable, or the path is a folder.
    """
    folder = path.absolute().parent
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; give a file")
    if not folder.is_dir():
        raise InputError(f"--out {path}: folder {folder} does not exist; create it first")
    if not os.access(folder, os.W_OK):
        raise InputError(f"--out {path}: folder {folder} is not writable; give another file")
