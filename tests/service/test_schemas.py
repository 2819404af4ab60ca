"""What `/openapi.json` states is what the service sends, and what generators of clients need."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evercal.bounds import RequestBounds
from evercal.geometry import SE3
from evercal.map import Map
from evercal.mapping.build import MapOptions
from evercal.mapping.store import MapStore
from evercal.recordings import write_image

jsonschema = pytest.importorskip("jsonschema")
IN_FILE = "/localize", "/calibrations", "/check"


@pytest.fixture
def stated(hall_service) -> dict[str, Any]:
    return hall_service.get("/openapi.json").json


def require_as_stated(stated, path: str, got) -> None:
    """An answer has the schema of its path and status, and no field that the schema lacks."""
    schemas = stated["components"]["schemas"]
    for schema in schemas.values():
        if schema["type"] == "object":
            schema.setdefault("additionalProperties", False)
    method = "post" if path in IN_FILE else "get"
    responses = stated["paths"][path][method]["responses"]
    code = str(got.status)
    response = responses.get(code) or responses[f"{code[0]}XX"]
    schema = response["content"]["application/json"]["schema"]
    whole = {**schema, "components": {"schemas": schemas}}
    jsonschema.Draft202012Validator(whole).validate(got.json)


def test_answers_are_as_stated(stated, hall_service, image, tmp_path):
    write_image(tmp_path / "black.png", np.zeros((240, 320, 3), np.uint8))
    for given, status in ((image, "ok"), (tmp_path / "black.png", "failed")):
        got = hall_service.post("/localize", image=given)
        assert got.json["status"] in (status, "unknown_scene")
        require_as_stated(stated, "/localize", got)
        more = replace(got, body=json.dumps({**got.json, "more": 1}).encode())
        with pytest.raises(jsonschema.ValidationError):
            require_as_stated(stated, "/localize", more)
    for path in ("/health", "/scenes"):
        require_as_stated(stated, path, hall_service.get(path))


def test_calibrations_of_both_mounts_and_a_shift_are_as_stated(
    stated, hall_service, hall, tmp_path
):
    files = []
    poses = ["x,y,z,qw,qx,qy,qz"]
    gripper_from_camera = SE3.exp([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    for i, frame in enumerate(hall.test[::4]):
        files.append(tmp_path / f"{i}.png")
        write_image(files[-1], frame.read_image())
        arm = frame.base_from_camera @ gripper_from_camera.inverse()
        numbers = [*arm.translation_m.tolist(), *arm.rotation_wxyz.tolist()]
        poses.append(",".join(map(str, numbers)))
    table = ("poses.csv", "\n".join(poses).encode())
    got = hall_service.post("/calibrations", images=files, robot_poses=table)
    assert got.json["mount"] == "eye_in_hand"
    require_as_stated(stated, "/calibrations", got)
    got = hall_service.post("/calibrations", images=files[0])
    assert got.json["mount"] == "eye_to_hand"
    require_as_stated(stated, "/calibrations", got)
    shift = hall_service.post(
        "/check", images=files[0], calibration=("c.json", got.body)
    )
    assert not shift.json["moved"]
    require_as_stated(stated, "/check", shift)


def test_an_ambiguous_image_is_as_stated(stated, serve, arcs, tmp_path):
    root = tmp_path / "map"
    cell = Map(MapStore.create(root, short_side=120))
    recording = arcs[0]
    moved = []
    for frame in recording.train:
        base_from_camera = SE3.exp([0.05, 0, 0, 0, 0, 0.1]) @ frame.base_from_camera
        moved.append(replace(frame, base_from_camera=base_from_camera))
    other = replace(recording, name="other", train=tuple(moved), test=())
    for scene in (recording, other):
        cell.learn(scene, options=MapOptions(adjust=False))
    write_image(tmp_path / "a.png", recording.test[0].read_image())
    with serve(root) as service:
        got = service.post("/localize", image=tmp_path / "a.png")
    assert got.json["status"] == "ambiguous"
    assert len(got.json["alternatives"]) == 2
    require_as_stated(stated, "/localize", got)


def test_every_error_is_as_stated(stated, serve, hall_service, hall_store, image, copy):
    def asked(service, **headers) -> None:
        for path in IN_FILE:
            got = service.ask("POST", path, b"", headers)
            require_as_stated(stated, path, got)
            statuses.add(got.status)
        for path in ("/health", "/scenes", "/metrics"):
            got = service.get(path, **headers)
            if got.status >= 400:
                require_as_stated(stated, path, got)

    statuses = set[int]()
    asked(hall_service)
    asked(hall_service, Host="elsewhere.example")
    asked(hall_service, **{"Content-Length": str(10**12)})
    asked(hall_service, **{"Content-Type": "text/plain; charset=utf-16"})
    asked(hall_service, **{"X-Long": "x" * 40_000})
    asked(hall_service, **{"Transfer-Encoding": "chunked"})
    for got in (
        hall_service.post("/localize", image=("a.png", b"x")),
        hall_service.post("/localize", image=image, scene="nowhere"),
        hall_service.post("/localize", image="text"),
        hall_service.post("/localize", camra="x"),
    ):
        require_as_stated(stated, "/localize", got)
        statuses.add(got.status)
    with serve(hall_store, token="a-token-of-16-characters") as service:
        asked(service)
    with serve(hall_store, limits=RequestBounds(requests=0)) as service:
        got = service.post("/localize", image=image)
        require_as_stated(stated, "/localize", got)
        statuses.add(got.status)
    with serve(copy / "empty") as service:
        got = service.post("/localize", image=image)
        require_as_stated(stated, "/localize", got)
        statuses.add(got.status)
    assert statuses == {400, 401, 403, 411, 413, 415, 422, 429, 431, 503}


def test_generators_find_files_operations_and_one_error(stated):
    paths = stated["paths"]
    operations = {
        path: (key, operation)
        for path, item in paths.items()
        for key, operation in item.items()
    }
    assert {operation["operationId"] for _, operation in operations.values()} == {
        "localize", "calibrate", "check", "scenes", "health", "metrics",
    }  # fmt: skip
    bodies = {
        name: schema["properties"]
        for name, schema in stated["components"]["schemas"].items()
        if name.startswith("Body_")
    }
    assert set(bodies) == {"Body_localize", "Body_calibrate", "Body_check"}
    file = {"type": "string", "format": "binary"}
    for fields in bodies.values():
        for name in ("image", "camera", "robot_poses", "calibration"):
            field = fields.get(name, file)
            assert {key: field[key] for key in file} == file
        assert fields.get("images", {"items": file})["items"] == file
        assert "default" not in fields["scene"]
    problem = {"$ref": "#/components/schemas/Problem"}
    described = {tag["name"] for tag in stated["tags"] if tag["description"]}
    for _, operation in operations.values():
        assert operation["tags"][0] in described
        assert "422" not in operation["responses"]
        for status in ("4XX", "5XX"):
            content = operation["responses"][status]["content"]
            assert content["application/json"]["schema"] == problem


def test_the_page_says_what_the_service_is(stated, hall_service):
    text = stated["info"]["description"]
    for word in ("PNG", "metres", "w, x, y, z", "Bearer", "/track", "newest"):
        assert word in text
    assert b"dark-mode" in hall_service.get("/docs").body


def test_errors_name_what_a_client_can_change(hall_service, image):
    wide = ("p.csv", ",".join(f"c{i}" for i in range(200)).encode())
    got = hall_service.post("/calibrations", images=image, robot_poses=wide)
    owner = "whoever runs the service can raise it by --limits columns=200"
    assert got.refusal[1].endswith(f"at most 100 are read; if it is right, {owner}")
    for name, message in (
        ("camera", "camera: send a file: a part with a file name"),
        ("mount", "mount: Input should be 'eye_to_hand' or 'eye_in_hand'"),
    ):
        got = hall_service.post("/calibrations", images=image, **{name: "text"})
        assert got.refusal == (422, message)
    # What the line asks for is a field of the form.
    table = ("p.csv", b"100 200 300 10 20 30\n")
    got = hall_service.post("/calibrations", images=image, robot_poses=table)
    assert "`convention`" in got.refusal[1]
    got = hall_service.post(
        "/calibrations",
        images=image,
        robot_poses=table,
        convention="kuka",
        mount="eye_to_hand",
    )
    assert got.json["mount"] == "eye_to_hand"
    got = hall_service.post(
        "/calibrations", images=image, robot_poses=table, convention="kukka"
    )
    assert got.refusal[0] == 400
    assert "kukka" in got.refusal[1]
