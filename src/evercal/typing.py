"""Types of arrays by element, of paths and of records."""

import os
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.floating]
"""Floating point numbers: float64 unless a docstring states otherwise."""
Float32Array: TypeAlias = NDArray[np.float32]
"""Values of features and patches."""
IntArray: TypeAlias = NDArray[np.int64]
"""Indices and counts."""
BoolArray: TypeAlias = NDArray[np.bool_]
"""Masks."""
Image: TypeAlias = NDArray[np.uint8]
"""(H, W, 3) RGB or (H, W) grey."""
PathLike: TypeAlias = str | os.PathLike[str]
"""A file or folder of the caller."""
Strings: TypeAlias = tuple[str, ...]
"""Names or sentences."""
JsonObject: TypeAlias = dict[str, Any]
"""Values of JSON by name."""
Record: TypeAlias = Mapping[str, Any]
"""The same, for reading alone."""
Floats: TypeAlias = tuple[float, ...]
"""Numbers."""
Pair: TypeAlias = tuple[float, float]
"""Two numbers, such as millimetres and degrees."""
Triple: TypeAlias = tuple[float, float, float]
"""Three numbers, such as x, y and z."""
Size: TypeAlias = tuple[int, int]
"""Width and height in pixels; of a grid, rows and columns."""
ArrayPair: TypeAlias = tuple[Array, Array]
"""Two arrays."""
