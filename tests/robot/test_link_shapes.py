"""Surfaces of links: tiny URDFs with primitives and meshes that the test writes."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from evercal.errors import InputError
from evercal.robot.link_shapes import RobotBody, robot_body
from evercal.robot.robot_model import RobotModel

ROOT = (
    '<link name="base"><visual><geometry><box size="1 2 3"/></geometry></visual></link>'
)
MOVED = """<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
<origin xyz="0 0 1"/><axis xyz="0 0 1"/><limit lower="-1" upper="2"/></joint>"""
CUBE = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
QUADS = ("0132", "4576", "0451", "2376", "0264", "1573")


def cube(scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a cube in the first octant, its size `scale`."""
    quads = np.array([[*map(int, quad)] for quad in QUADS])
    return scale * np.array(CUBE, float), np.concatenate(
        [quads[:, :3], quads[:, [0, 2, 3]]]
    )


def write_stl(path: Path, scale: float = 1.0) -> None:
    vertices, faces = cube(scale)
    data = np.zeros(len(faces), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    data["v"] = vertices[faces]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(80) + np.uint32(len(faces)).tobytes() + data.tobytes())


def write_dae(path: Path, meter: str = "1", up: str = "Z_UP") -> None:
    """A cube of COLLADA, moved by its node by one along x."""
    vertices, faces = cube()
    text = f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{meter}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array id="f" count="24">
{" ".join(map(str, vertices.ravel()))}</float_array><technique_common>
<accessor source="#f" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
</source><vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{" ".join(map(str, faces.ravel()))}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="all"><node><translate>1 0 0</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#all"/></scene></COLLADA>"""
    path.write_text(text)


def read(folder: Path, links: str, **options: object) -> RobotBody:
    path = folder / "robot.urdf"
    path.write_text(f"<robot name='r'>{links}</robot>")
    return robot_body(RobotModel(path), (), **options)  # type: ignore[arg-type]


def mesh(file: str, scale: str = "", origin: str = "") -> str:
    return (
        f'<link name="base"><visual>{origin}<geometry><mesh filename="{file}" {scale}/>'
        "</geometry></visual></link>"
    )


def test_primitives_have_the_stated_sizes(tmp_path: Path) -> None:
    visual = '<visual><origin xyz="0 0 2" rpy="1.5707963 0 0"/><geometry>{}</geometry></visual>'
    tube = visual.format('<cylinder radius="0.1" length="2"/>')
    ball = visual.format('<sphere radius="0.5"/>')
    body = read(tmp_path, ROOT + MOVED + f'<link name="arm">{tube}{ball}</link>')
    box, arm = body.links
    assert (box.link, arm.link) == ("base", "arm")
    np.testing.assert_allclose(np.ptp(box.vertices, axis=0), (1, 2, 3))
    np.testing.assert_allclose(np.ptp(arm.vertices, axis=0), (1, 2, 1), atol=1e-3)
    np.testing.assert_allclose(arm.vertices.mean(0), (0, 0, 2), atol=1e-3)


def test_frames_are_those_of_the_joint_values(tmp_path: Path) -> None:
    body = read(tmp_path, ROOT + MOVED + ROOT.replace("base", "arm"))
    moving = robot_body(RobotModel(tmp_path / "robot.urdf"), ("other", "turn"))
    frames = moving.frames(np.array([[9.0, 0.0], [9.0, np.pi / 2]]))
    assert frames.shape == (2, 2, 4, 4)
    np.testing.assert_allclose(frames[0], [np.eye(4)] * 2)
    np.testing.assert_allclose(frames[1, :, :3, 3], [(0, 0, 1)] * 2)
    np.testing.assert_allclose(frames[1, 1, :3, 0], (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(body.frames(np.zeros((1, 0))), frames[:, :1])


def test_a_joint_whose_limits_exclude_zero_stands_in_their_middle(
    tmp_path: Path,
) -> None:
    moved = MOVED.replace('lower="-1"', 'lower="1"')
    body = read(tmp_path, ROOT + moved + ROOT.replace("base", "arm"))
    np.testing.assert_allclose(body.frames(np.zeros((1, 0)))[1, 0, 0, 0], np.cos(1.5))


def test_vertices_of_neighbouring_triangles_are_one(tmp_path: Path) -> None:
    write_stl(tmp_path / "cube.stl")
    (link,) = read(tmp_path, mesh("cube.stl")).links
    assert len(link.vertices) == 8
    edges = np.sort(link.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


@pytest.mark.parametrize("up", ["Z_UP", "Y_UP"])
def test_the_unit_of_a_dae_counts_and_its_upward_axis_does_not(
    tmp_path: Path, up: str
) -> None:
    write_dae(tmp_path / "cube.dae", "0.01", up)
    (link,) = read(tmp_path, mesh("cube.dae")).links
    np.testing.assert_allclose(link.vertices.min(0), (0.01, 0, 0), atol=1e-9)
    np.testing.assert_allclose(link.vertices.max(0), (0.02, 0.01, 0.01))


def test_a_mirrored_mesh_still_shows_its_outside(tmp_path: Path) -> None:
    write_stl(tmp_path / "cube.stl", 1000)
    (link,) = read(tmp_path, mesh("cube.stl", 'scale="0.001 -0.001 0.001"')).links
    np.testing.assert_allclose(link.vertices.min(0), (0, -1, 0), atol=1e-9)
    a, b, c = np.moveaxis(link.vertices[link.faces], 1, 0)
    volume = np.einsum("ij,ij", a, np.cross(b, c)) / 6
    plain = cube()
    a, b, c = np.moveaxis(plain[0][plain[1]], 1, 0)
    assert volume == pytest.approx(np.einsum("ij,ij", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("place", "variable"),
    [
        ("near/urdf/meshes", ""),
        ("near/meshes", ""),
        ("arm/meshes", ""),
        ("models/arm/meshes", ""),
        ("elsewhere/arm/meshes", "ROS_PACKAGE_PATH"),
        ("elsewhere/meshes", "ROS_PACKAGE_PATH"),
        ("elsewhere/share/arm/meshes", "AMENT_PREFIX_PATH"),
    ],
)
def test_packages_are_searched(
    tmp_path: Path, place: str, variable: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "near" / "urdf"
    folder.mkdir(parents=True)
    write_stl(tmp_path / place / "cube.stl")
    package = "arm"
    if "models" in place:
        package = "project/models/arm"
    if variable:
        monkeypatch.setenv(variable, f"/nowhere{os.pathsep}{tmp_path / 'elsewhere'}")
    assert read(folder, mesh(f"package://{package}/meshes/cube.stl")).links


def test_files_are_named_by_path(tmp_path: Path) -> None:
    write_stl(tmp_path / "a b.stl")
    assert read(tmp_path, mesh((tmp_path / "a b.stl").as_uri())).links
    assert read(tmp_path, mesh(str(tmp_path / "a b.stl"))).links


def test_collision_geometry_stands_for_visual_geometry_that_no_link_has(
    tmp_path: Path,
) -> None:
    body = read(tmp_path, ROOT.replace("visual", "collision"))
    assert len(body.links) == 1
    distance = ROOT.replace("visual", "collision").replace("base", "arm")
    assert [link.link for link in read(tmp_path, ROOT + MOVED + distance).links] == [
        "base"
    ]


def test_a_mesh_survives_a_missing_texture(tmp_path: Path) -> None:
    write_dae(tmp_path / "cube.dae")
    text = (tmp_path / "cube.dae").read_text()
    bound = """<instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="m" target="#lost"/></technique_common></bind_material>
</instance_geometry>"""
    text = text.replace('<instance_geometry url="#g"/>', bound)
    # A line break before the declaration, as in files of Doosan.
    (tmp_path / "cube.dae").write_text("\n" + text)
    assert read(tmp_path, mesh("cube.dae")).links


def test_all_parts_of_an_obj_count(tmp_path: Path) -> None:
    lines = [f"v {x} {y} {z}" for x, y, z in CUBE]
    for number, quad in enumerate(QUADS):
        corners = " ".join(str(int(corner) + 1) for corner in quad)
        lines += [f"o side{number}", f"usemtl colour{number}", f"f {corners}"]
    (tmp_path / "cube.obj").write_text("\n".join(["mtllib lost.mtl", *lines]))
    (link,) = read(tmp_path, mesh("cube.obj")).links
    assert (len(link.vertices), len(link.faces)) == (8, 12)


def test_fine_meshes_are_simplified(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(6, 0.03)
    assert len(ball.faces) > 80_000
    ball.export(tmp_path / "ball.stl")
    (link,) = read(tmp_path, mesh("ball.stl")).links
    assert len(link.faces) < 60_000
    radius = np.linalg.norm(link.vertices, axis=1)
    np.testing.assert_allclose(radius, 0.03, atol=1e-5)


def refused(problem: str, folder: Path, links: str, **options: object) -> None:
    with pytest.raises(InputError, match=problem):
        read(folder, links, **options)


def test_bad_geometry_is_named(tmp_path: Path) -> None:
    write_stl(tmp_path / "cube.stl", 1000)
    (tmp_path / "bad.stl").write_bytes(b"no mesh")
    (tmp_path / "bad.dae").write_bytes(b"<!DOCTYPE x><x/>")
    (tmp_path / "wide.dae").write_text("<!DOCTYPE x><x/>", "utf-16")
    write_dae(tmp_path / "empty.dae")
    text = (tmp_path / "empty.dae").read_text()
    (tmp_path / "empty.dae").write_text(text.replace("triangles", "lines"))
    for links, problem in (
        (
            mesh("lost.stl"),
            f"link base: its mesh lost.stl is not found in {re.escape(str(tmp_path))}, .*`without`",
        ),
        (mesh("cube.blend"), "link base: its mesh 'cube.blend' is none of stl, dae"),
        (mesh("cube.stl"), "link base: is 1000 m large; .*scale="),
        (mesh("cube.stl", 'scale="1 x 1"'), "visual of link base: could not convert"),
        ('<link name="base"><visual><geometry/></visual></link>', "is no mesh, box"),
        (mesh("bad.stl"), "bad.stl: cannot be read as a mesh"),
        (mesh("bad.dae"), "bad.dae: cannot be read as a mesh .*DOCTYPE"),
        (mesh("wide.dae"), "wide.dae: cannot be read as a mesh .*DOCTYPE"),
        (
            mesh("empty.dae"),
            "empty.dae: .*it has no triangles; leave the link out by `without`",
        ),
        ('<link name="base"/>', "no link has geometry"),
    ):
        refused(problem, tmp_path, links)
    refused("has no link bse .nearest: base", tmp_path, ROOT, without=["bse"])
    refused("no link has geometry", tmp_path, ROOT, without=["base"])


def test_large_meshes_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_stl(tmp_path / "cube.stl")
    monkeypatch.setenv("EVERCAL_LIMITS", "mesh_bytes=600")
    refused(
        "684 bytes of meshes, at most 600 are read; .*mesh_bytes=684",
        tmp_path,
        mesh("cube.stl"),
    )
    monkeypatch.setenv("EVERCAL_LIMITS", "faces=10")
    refused("12 triangles of meshes, at most 10", tmp_path, mesh("cube.stl"))
