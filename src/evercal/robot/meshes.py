"""Triangles of mesh files, and where a URDF's names of them lead."""

import os
import re
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote
from warnings import catch_warnings, simplefilter

import numpy as np

from evercal.errors import optional_module
from evercal.storage.text_files import library_errors
from evercal.typing import Array, IntArray

_NEED = "meshes of a robot need trimesh and pycollada"
_UNIT = re.compile(rb"<unit[^>]*\smeter\s*=\s*[\"']\s*([0-9.eE+-]+)\s*[\"']")
_KINDS = ("stl", "dae", "obj", "ply")


class Triangles(NamedTuple):
    """A surface."""

    vertices: Array
    """(n, 3) metres."""
    faces: IntArray
    """(m, 3) vertices of each triangle, counterclockwise as seen from outside."""


def mesh_file(urdf: Path, name: str) -> Path:
    """The file that a URDF means by the name of a mesh.

    Raises:
        ValueError: It is not found, or its format is unknown.
    """
    if Path(name).suffix[1:].lower() not in _KINDS:
        raise ValueError(
            f"its mesh {name!r} is none of {', '.join(_KINDS)}; convert it"
        )
    places = [*_places(urdf, name)]
    for place in places:
        if place.is_file():
            return place
    folders = dict.fromkeys(str(place.parent) for place in places[:2])
    raise ValueError(
        f"its mesh {name} is not found, neither in {' nor in '.join(folders)}"
        " nor in the folders above the URDF or ROS_PACKAGE_PATH; put the meshes beside it"
    )


def _places(urdf: Path, name: str) -> Iterator[Path]:
    scheme, _, rest = name.rpartition("://")
    if scheme == "file":
        rest = unquote(rest.removeprefix("localhost"))
    if scheme != "package":
        yield urdf.parent / rest
        return
    package, _, rest = rest.partition("/")
    folders = urdf.resolve().parents
    for folder in folders:
        if folder.name == package or _is_package(folder, package):
            yield folder / rest
        yield folder / package / rest
    for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep):
        yield Path(folder, package, rest)
        if _is_package(Path(folder), package):
            yield Path(folder, rest)
    for folder in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        yield Path(folder, "share", package, rest)
    for folder in folders:
        yield folder / rest


def _is_package(folder: Path, name: str) -> bool:
    """Whether a folder holds the ROS package of this name."""
    manifest = folder / "package.xml"
    if not manifest.is_file():
        return False
    text = manifest.read_bytes()[:100_000]
    return (
        re.search(rb"<name>\s*" + re.escape(name.encode()) + rb"\s*</name>", text)
        is not None
    )


def read_mesh(path: Path) -> Triangles:
    """All triangles of a mesh file, in its unit or, if it states that, in metres.

    As in RViz, the unit of a DAE counts and its upward axis does not.
    """
    data = path.read_bytes()
    kind = path.suffix[1:].lower()
    with library_errors(f"{path}: cannot be read as a mesh"):
        if kind == "dae":
            mesh = _collada(data)
        else:
            mesh = _loaded(data, kind)
        if not len(mesh.faces):
            raise ValueError("it holds no triangles")
    return mesh


def _loaded(data: bytes, kind: str) -> Triangles:
    trimesh = optional_module("trimesh", _NEED, "urdf")
    mesh = trimesh.load_mesh(BytesIO(data), kind, process=False, skip_materials=True)
    return Triangles(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def _collada(data: bytes) -> Triangles:
    if b"<!DOCTYPE" in data:
        raise ValueError("it has a DOCTYPE, which no mesh needs; remove it")
    collada = optional_module("collada", _NEED, "urdf")
    corners = [np.empty((0, 3))]
    with catch_warnings():
        simplefilter("ignore", PendingDeprecationWarning)  # it uses np.matrix
        document = collada.Collada(BytesIO(data), ignore=[collada.common.DaeError])
        for geometry in document.scene.objects("geometry"):
            for primitive in geometry.primitives():
                corners += _corners(primitive)
    unit = _UNIT.search(data[:10_000])
    scale = 1.0
    if unit:
        scale = float(unit[1])
    vertices = scale * np.concatenate(corners)
    return Triangles(vertices, np.arange(len(vertices)).reshape(-1, 3))


def _corners(primitive: Any) -> list[Array]:
    """(3 m, 3) corners of the triangles of polygons; none of lines."""
    if hasattr(primitive, "triangleset"):
        primitive = primitive.triangleset()
    index = getattr(primitive, "vertex_index", None)
    if index is None or primitive.vertex is None or np.shape(index)[1:] != (3,):
        return []
    return [np.asarray(primitive.vertex, float)[index.ravel()]]


def joined(parts: Sequence[Triangles]) -> Triangles:
    """All triangles of several surfaces."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    vertices = [part.vertices for part in parts]
    return Triangles(np.concatenate(vertices), np.concatenate(faces))


def merged(mesh: Triangles, cell: float) -> Triangles:
    """The mesh with one vertex, the mean, for those in one cell of a grid (metres).

    Triangles that shrink to a line, and repeated ones, are left out.
    """
    cells = np.round(mesh.vertices / cell).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, column, len(count)) for column in mesh.vertices.T]
    vertices = np.stack(sums, 1) / count[:, None]
    faces = index[mesh.faces]
    corners = np.sort(faces, 1)
    whole = (np.diff(corners, axis=1) > 0).all(1)
    _, first = np.unique(corners[whole], axis=0, return_index=True)
    return Triangles(vertices, faces[whole][np.sort(first)])
