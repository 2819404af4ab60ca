"""`JointMap`: joint values of a URDF from columns of numbers, as a file states it.

Each joint stands at unit * (factor * column + ...) + offset.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.storage.text_files import named_errors, read_json
from evercal.typing import Array, JsonObject, PathLike, Strings

UNITS = {
    "rad": 1.0,
    "deg": np.pi / 180,
    "steps": 2 * np.pi / 4096,
    "m": 1.0,
    "mm": 0.001,
}
"""Units of columns, radians or metres."""
_FORM = (
    '{"joints": {"elbow": {"columns": {"J3": -1, "J2": 1}, "unit": "deg", "offset_deg": 90}}}'
    f" with a unit of {', '.join(UNITS)} or degrees for each count"
)


@frozen_arrays
class JointMap:
    """Joint values q = matrix @ columns + offsets."""

    joints: Strings
    """(k,) names of the joints."""
    columns: Strings
    """(m,) names of columns."""
    matrix: Array
    """(k, m) radians, or metres of sliding joints, for each unit of a column."""
    offsets: Array
    """(k,) radians, or metres."""

    @classmethod
    def of_columns(
        cls,
        joints: Sequence[str],
        columns: Sequence[str],
        units: Array,
    ) -> Self:
        """Each joint is one column, in units (k,)."""
        offsets = np.zeros(len(units))
        return cls(
            (*joints,),
            (*columns,),
            np.diag(units),
            offsets,
        )

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of `record`."""
        data = read_json(path, "joint map", f"give {_FORM}")
        with named_errors(path, "joint map"):
            entries = data.get("joints")
            if not isinstance(entries, dict) or not entries:
                raise ValueError(f"no joint map; give {_FORM}")
            rows = [_row(joint, entry) for joint, entry in entries.items()]
        columns = [*dict.fromkeys(column for row, _ in rows for column in row)]
        matrix = np.zeros((len(rows), len(columns)))
        for i, (row, _) in enumerate(rows):
            for column, factor in row.items():
                matrix[i, columns.index(column)] = factor
        offsets = np.array([offset for _, offset in rows])
        return cls(
            (*entries,),
            (*columns,),
            matrix,
            offsets,
        )

    def values(self, values: Array) -> Array:
        """(n, k) values of the joints, from columns (n, m)."""
        return values @ self.matrix.T + self.offsets

    def with_others(
        self,
        others: Self,
        source: PathLike,
    ) -> Self:
        """The joints of this map, and those of a map of all columns of a file."""
        missing = [column for column in self.columns if column not in others.columns]
        if missing:
            raise InputError(
                f"{source}: has no column {', '.join(missing)}, which the joint map names; there"
                f" are {', '.join(others.columns)}"
            )
        matrix = np.zeros((len(self.joints), len(others.columns)))
        matrix[:, [*map(others.columns.index, self.columns)]] = self.matrix
        rest = []
        for joint, column in zip(
            others.joints,
            others.columns,
            strict=True,
        ):
            if joint not in self.joints and column not in self.columns:
                rest.append(joint)
        kept = others.of(rest)
        return type(self)(
            (*self.joints, *rest),
            others.columns,
            np.concatenate([matrix, kept.matrix]),
            np.concatenate([self.offsets, kept.offsets]),
        )

    def of(self, joints: Sequence[str]) -> Self:
        """The part of some joints, in their order."""
        rows = [*map(self.joints.index, joints)]
        return replace(
            self,
            joints=(*joints,),
            matrix=self.matrix[rows],
            offsets=self.offsets[rows],
        )

    def after(
        self,
        matrix: Array,
        offsets: Array,
    ) -> Self:
        """Joints that stand at matrix (k, k) @ what this map gives + offsets (k,)."""
        both = matrix @ self.offsets + offsets
        return replace(self, matrix=matrix @ self.matrix, offsets=both)

    def record(self, rotates: Sequence[bool]) -> JsonObject:
        """The map as JSON."""
        entries = {}
        rows = zip(
            self.joints,
            rotates,
            self.matrix,
            self.offsets,
            strict=True,
        )
        for joint, turns, row, offset in rows:
            size = np.abs(row).max()
            entry: JsonObject = {"offset_m": offset}
            units = ["m", "mm"]
            if turns:
                degrees = (np.rad2deg(offset) + 180) % 360 - 180
                entry = {"offset_deg": round(degrees, 3)}
                units = ["rad", "deg", "steps", np.rad2deg(size)]
            exact = [
                unit
                for unit in units
                if np.isclose(
                    _size(unit),
                    size,
                    1e-6,
                    0,
                )
            ]
            (entry["unit"], *_) = *exact, "m"
            factors = np.round(row / _size(entry["unit"]), 9).tolist()
            named = zip(self.columns, factors, strict=True)
            entry["columns"] = {column: factor for column, factor in named if factor}
            entries[joint] = entry
        return {"joints": entries}


def _size(unit: Any) -> float:
    """Radians or metres of a unit, which is a name or a number of degrees."""
    return UNITS.get(unit) or np.deg2rad(float(unit))


def _row(joint: str, entry: Any) -> tuple[dict[str, float], float]:
    """Factors of the columns of a joint, and its offset."""
    with suppress(
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
    ):
        size = _size(entry["unit"])
        row = {c: size * float(factor) for c, factor in entry["columns"].items()}
        degrees = entry.get("offset_deg", 0)
        offset = np.deg2rad(degrees) + entry.get("offset_m", 0)
        known = entry.keys() <= {"columns", "unit", "offset_deg", "offset_m"}
        if known and row and np.isfinite([*row.values(), offset]).all():
            return row, offset
    raise ValueError(f"joint {joint} is {entry}; give {_FORM}")
