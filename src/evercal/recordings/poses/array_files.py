"""Arrays of NPY, NPZ and MATLAB files as nested lists."""

import math
import re
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from evercal.bounds import require_at_most
from evercal.processes import status_of
from evercal.storage.text_files import library_errors
from evercal.typing import JsonObject

_READ = f"""
import sys
from {__name__} import matlab_arrays
print(flush=True)
matlab_arrays(open(sys.argv[1], "rb"))
"""
"""Program that ends once a MATLAB file is read."""
_LONGEST_S = 60.0
"""Time for reading a MATLAB file."""


def arrays_as_lists(path: Path) -> Any:
    """An array of NPY as lists, or arrays of NPZ or MAT by name; InputError for damaged files."""
    with path.open("rb") as file, library_errors(f"{path}: no readable arrays"):
        if path.suffix.lower() == ".mat":
            # On a damaged file SciPy may end the process, so another one reads it first.
            status = status_of(_READ, str(path), seconds=_LONGEST_S)
            if status is None or status < 0:
                raise ValueError("a damaged MATLAB file; save it again")
            return matlab_arrays(file)
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as archive:
                count = 0
                for entry in archive.infolist():
                    with archive.open(entry) as member:
                        count += _numbers_of(member)
        else:
            file.seek(0)
            count = _numbers_of(file)
        require_at_most(count, "numbers", "numbers")
        file.seek(0)
        loaded = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded.tolist()
        return {key: loaded[key].tolist() for key in loaded.files}


def matlab_arrays(file: IO[bytes]) -> JsonObject:
    """Arrays of numbers in a MATLAB file, by name."""
    from scipy.io import loadmat, whosmat

    numeric = re.compile("double|single|u?int(8|16|32|64)")
    names = []
    count = 0
    for name, shape, kind in whosmat(file):
        if numeric.fullmatch(kind):
            names.append(name)
            count += math.prod(shape)
    require_at_most(count, "numbers", "numbers")
    file.seek(0)
    loaded = loadmat(file, variable_names=names)
    return {name: loaded[name].tolist() for name in names}


def _numbers_of(file: IO[bytes]) -> int:
    """Count of numbers by the shape that an array states."""
    if np.lib.format.read_magic(file) == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    if dtype.hasobject:
        raise ValueError("Python objects; save arrays of numbers")
    words = max(dtype.itemsize, 8)
    return math.prod(shape) * words // 8
