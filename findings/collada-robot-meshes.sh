#!/usr/bin/env bash
# Meshes of robots in COLLADA, read by trimesh 5.2.0 (with pycollada 0.9.3), yourdfpy 0.0.60 and coal
# of pin 4.1.0. All ignore <unit meter="0.0254">, which RViz heeds (getMeshUnitRescale in its public
# mesh_loader.cpp) and files of KUKA's KR210, Laikago and TurtleBot state: they come out 39 times too
# large. All ignore <up_axis>, and so does RViz. Where a mesh names a material that the file lacks,
# such as one whose texture was lost, trimesh and yourdfpy return no geometry, without an error: ANYmal
# B of example-robot-data 6.0.0 has no feet there.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 trimesh==5.2.0 pycollada==0.9.3 lxml==6.1.3 \
    yourdfpy==0.0.60 pin==4.1.0
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import logging
from importlib.metadata import version

import coal
import numpy as np
import trimesh
import yourdfpy

logging.disable()
print(*(f"{name} {version(name)}" for name in ("trimesh", "pycollada", "yourdfpy", "coal")), sep=", ")
TETRAHEDRON = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2026-01-01T00:00:00</created><modified>2026-01-01T00:00:00</modified>
<unit name="unit" meter="{meter}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array id="f" count="12">
0 0 0 1 0 0 0 2 0 0 0 3</float_array><technique_common><accessor source="#f" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" source="#s"/>
</vertices><triangles count="4" material="m"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="all"><node id="n"><instance_geometry url="#g">{bind}
</instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#all"/></scene></COLLADA>"""
LOST = """<bind_material><technique_common><instance_material symbol="m" target="#lost"/>
</technique_common></bind_material>"""
URDF = """<robot name="r"><link name="a"><visual><geometry><mesh filename="mesh.dae"/></geometry>
</visual></link></robot>"""


def by_coal():
    vertices = coal.MeshLoader().load("mesh.dae", np.ones(3)).vertices()
    return np.ptp(np.array(vertices), axis=0)


def sizes(title, meter="1", up="Z_UP", bind=""):
    with open("mesh.dae", "w") as file:
        file.write(TETRAHEDRON.format(meter=meter, up=up, bind=bind))
    with open("robot.urdf", "w") as file:
        file.write(URDF)
    found = (
        trimesh.load_mesh("mesh.dae").extents,
        yourdfpy.URDF.load("robot.urdf").scene.extents,
        by_coal(),
    )
    found = [None if size is None else np.round(size, 4).tolist() for size in found]
    print(f"{title}: {found}")
    return found


size = [1.0, 2.0, 3.0]
assert sizes("sides of 1, 2, 3 m") == [size] * 3
assert sizes("the same in inches, 0.0254, 0.0508, 0.0762 m", meter="0.0254") == [size] * 3
assert sizes("the same, Y_UP", up="Y_UP") == [size] * 3
assert sizes("the same, its material is lost", bind=LOST) == [None, None, size]
PYTHON
