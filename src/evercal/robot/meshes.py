"""Triangles of mesh files, and the files that a URDF means."""

import os
import re
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote
from warnings import catch_warnings, simplefilter

import numpy as np

from evercal.errors import optional_module
from evercal.storage.text_files import library_errors
from evercal.typing import Array, IntArray

_NEED = "meshes of a robot need trimesh and pycollada"
_KINDS = ("stl", "dae", "obj", "ply")
_PACKAGES = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
"""Environment variables of folders with ROS packages."""
_UNIT = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']*)")
_MATERIALS = re.compile(rb"<(bind_material|library_effects)\b.*?</\1>", re.DOTALL)
"""A DAE loses what has a material with a fault, such as a missing texture."""


class Triangles(NamedTuple):
    """A surface."""

    vertices: Array
    """(n, 3) metres."""
    faces: IntArray
    """(m, 3) vertices of each triangle, counterclockwise as seen from outside."""


def mesh_file(urdf: Path, name: str) -> Path:
    """The file that a URDF means by the name of a mesh.

    It is searched beside the URDF, in the folders above it and in those of ROS packages. Without
    the folder of its package it is searched last, as a package may have been copied under another
    name.

    Raises:
        ValueError: There is none, or its format is unknown.
    """
    scheme, _, path = name.rpartition("://")
    if Path(path).suffix[1:].lower() not in _KINDS:
        raise ValueError(f"its mesh {name!r} is none of {', '.join(_KINDS)}")
    if scheme == "file":
        path = unquote(path)
    roots = [*urdf.resolve().parents]
    for variable in _PACKAGES:
        folders = os.environ.get(variable, "").split(os.pathsep)
        roots += map(Path, filter(None, folders))
    _, _, inside = path.partition("/")
    for place in (path, f"share/{path}", inside):
        for root in roots:
            if (root / place).is_file():
                return root / place
    raise ValueError(
        f"its mesh {name} is not found in {urdf.parent}, the folders above it and those of"
        f" {' and '.join(_PACKAGES)}; put the meshes beside the URDF, or"
        " leave the link out by `without`"
    )


def read_mesh(path: Path) -> Triangles:
    """All triangles of a mesh file, in its unit or, if a DAE states that, in metres.

    As in RViz, the upward axis of a DAE does not count.
    """
    data = path.read_bytes()
    kind = path.suffix[1:].lower()
    trimesh = optional_module("trimesh", _NEED, "urdf")
    scale = 1.0
    with library_errors(f"{path}: cannot be read as a mesh"), catch_warnings():
        if kind == "dae":
            optional_module("collada", _NEED, "urdf")
            simplefilter("ignore", PendingDeprecationWarning)  # it uses np.matrix
            if b"<!DOCTYPE" in data:
                raise ValueError("it has a DOCTYPE, which no mesh needs; remove it")
            if unit := _UNIT.search(data):
                scale = float(unit[1])
            data = _MATERIALS.sub(b"", data)
        mesh = trimesh.load_mesh(
            BytesIO(data), kind, process=False, skip_materials=True
        )
        if not len(mesh.faces):
            raise ValueError("it holds no triangles")
        return Triangles(scale * mesh.vertices, np.asarray(mesh.faces, np.int64))


def joined(parts: Sequence[Triangles]) -> Triangles:
    """All triangles of several surfaces."""
    vertices = []
    faces = []
    count = 0
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + count)
        count += len(part.vertices)
    return Triangles(np.concatenate(vertices), np.concatenate(faces))


def merged(mesh: Triangles, cell_m: float) -> Triangles:
    """The mesh with one vertex, the mean, for those in one cell of a grid.

    Triangles that shrink to a line, and repeated ones, are left out.
    """
    cells = np.round(mesh.vertices / cell_m).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, column) for column in mesh.vertices.T]
    vertices = np.stack(sums, 1) / count[:, None]
    faces = index[mesh.faces]
    corners = np.sort(faces, 1)
    _, first = np.unique(corners, axis=0, return_index=True)
    whole = (np.diff(corners[first], axis=1) > 0).all(1)
    return Triangles(vertices, faces[np.sort(first[whole])])
