"""Triangles of mesh files, and the files that a URDF means."""

import os
import re
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote
from warnings import catch_warnings, simplefilter

import numpy as np

from evercal.bounds import require_at_most
from evercal.errors import optional_module
from evercal.storage.text_files import decoded, library_errors
from evercal.typing import Array, IntArray

_NEED = "meshes of a robot need trimesh and pycollada"
_KINDS = ("stl", "dae", "obj", "ply")
_PACKAGES = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
"""Environment variables of folders with ROS packages."""
_MOST_NODES = 30
"""Most repeated nodes of a DAE; public robots have one."""
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*>\s*")


def mesh_file(urdf: Path, name: str) -> Path:
    """The file that a URDF means by the name of a mesh.

    It is searched in the folders above the URDF and in those of ROS packages, then without the
    first folders of its name: a package may have been copied under another name.

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
        for folder in filter(None, os.environ.get(variable, "").split(os.pathsep)):
            roots += Path(folder), Path(folder, "share")
    while path:
        for root in roots:
            if (root / path).is_file():
                return root / path
        path = path.partition("/")[2]
    raise ValueError(
        f"its mesh {name} is not found in {urdf.parent}, the folders above it and those of"
        f" {' and '.join(_PACKAGES)}; put the meshes beside the URDF, or leave the link out by"
        " `without`"
    )


def read_mesh(path: Path) -> Array:
    """(m, 3, 3) corners of the triangles of a file, in its unit or, if a DAE states it, in metres.

    They are counterclockwise as seen from outside. As in RViz, the upward axis of a DAE does not
    count.
    """
    kind = path.suffix[1:].lower()
    data = path.read_bytes()
    with library_errors(f"{path}: cannot be read as a mesh"), catch_warnings():
        if kind == "dae":
            simplefilter("ignore", PendingDeprecationWarning)  # it uses np.matrix
            corners = _collada(decoded(data))
        else:
            trimesh = optional_module("trimesh", _NEED, "urdf")
            mesh = trimesh.load_mesh(
                BytesIO(data), kind, process=False, skip_materials=True
            )
            corners = np.array(mesh.vertices[mesh.faces], float)
        if not len(corners):
            raise ValueError("it has no triangles; leave the link out by `without`")
    return corners


def _collada(text: str) -> Array:
    """Corners of COLLADA. Nodes may repeat nodes without limit, so their number is bounded."""
    if "<!DOCTYPE" in text or text.count("instance_node") > _MOST_NODES:
        raise ValueError("it has a DOCTYPE or many instance_node; export it without")
    collada = optional_module("collada", _NEED, "urdf")
    # A fault of a material, such as a missing texture, would cost what has it.
    text = _DECLARATION.sub("", text).replace("bind_material", "extra")
    document = collada.Collada(BytesIO(text.encode()), ignore=[collada.common.DaeError])
    corners = [np.empty((0, 3, 3))]
    count = 0
    for geometry in document.scene.objects("geometry"):
        require_at_most(count, "faces", "triangles of meshes")
        for part in geometry.primitives():
            if hasattr(part, "triangleset"):
                part = part.triangleset()
            if isinstance(part, collada.triangleset.BoundTriangleSet):
                corners.append(part.vertex[part.vertex_index])
                count += len(part)
    return np.concatenate(corners) * (document.assetInfo.unitmeter or 1.0)


def merged(corners: Array, cell_m: float) -> tuple[Array, IntArray]:
    """Vertices and faces of triangles (m, 3, 3): the mean of the corners in each cell of a grid.

    Triangles that shrink to a line, and repeated ones, are left out.
    """
    points = corners.reshape(-1, 3)
    cells = np.round(points / cell_m).astype(np.int64)
    _, index, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, column) for column in points.T]
    vertices = np.stack(sums, 1) / count[:, None]
    faces = index.reshape(-1, 3)
    ordered = np.sort(faces, 1)
    _, first = np.unique(ordered, axis=0, return_index=True)
    whole = (np.diff(ordered[first], axis=1) > 0).all(1)
    return vertices, faces[np.sort(first[whole])]
