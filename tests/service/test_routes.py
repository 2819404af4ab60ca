"""The service answers as the command line does, and refuses with one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.bounds import RequestBounds
from evercal.map import Map
from evercal.recordings import read_image
from evercal.reports.answers import Answer, answer_row

from .malformed import png


def test_localize_gives_the_row_of_the_command(hall_service, hall_store, image, hall):
    opened = Map.open(hall_store)
    camera = hall.test[7].camera
    lens = ("camera.json", json.dumps(camera.to_dict()).encode())
    for given, parts in ((None, {}), (camera, {"camera": lens})):
        got = hall_service.post("/localize", image=image, **parts)
        assert got.status == 200
        estimate = opened.localize(read_image(image), given)
        row = answer_row(Answer(Path("hall.png"), estimate, got.json["ms"]))
        assert row["status"] == "ok"
        assert got.json["ms"] > 0
        assert got.json == json.loads(json.dumps(row))


def test_an_unknown_place_is_an_answer(hall_service, tmp_path):
    from evercal.recordings import write_image

    write_image(tmp_path / "black.png", np.zeros((240, 320, 3), np.uint8))
    got = hall_service.post("/localize", image=tmp_path / "black.png")
    assert got.status == 200
    assert got.json["status"] in ("unknown_scene", "failed")
    assert got.json["base_from_camera"] is None


def test_health_scenes_page_and_metrics(hall_service, image):
    assert hall_service.get("/health").json == {"status": "ok", "scenes": 1}
    assert hall_service.get("/scenes").json == {"scenes": ["hall"]}
    assert b"swagger" in hall_service.get("/docs").body
    paths = hall_service.get("/openapi.json").json["paths"]
    assert set(paths) == {
        "/health", "/scenes", "/localize", "/calibrations", "/check", "/metrics",
    }  # fmt: skip

    def count(line: str) -> float:
        text = hall_service.get("/metrics").body.decode()
        values = [row.split()[-1] for row in text.splitlines() if row.startswith(line)]
        return float(values[0]) if values else 0.0

    line = 'evercal_requests_total{method="POST",route="/localize",status="200"}'
    before = count(line)
    answers = count('evercal_answers_total{status="ok"}')
    hall_service.post("/localize", image=image)
    assert count(line) == before + 1
    assert count('evercal_answers_total{status="ok"}') == answers + 1
    assert count("evercal_scenes") == 1


@pytest.mark.parametrize(
    ("path", "parts", "status", "message"),
    [
        ("localize", {}, 422, "image: Field required"),
        ("localize", {"image": "text"}, 422, "image: "),
        ("localize", {"image": ("a.png", b"")}, 400, "a.png: not a readable image"),
        ("localize", {"image": ("a.png", b"x" * 99)}, 400, "a.png: not a readable"),
        (
            "localize",
            {"image": ("a", png(60_000, 2, 0))},
            413,
            "a (60000x60000): 3,600,000,000 pixels",
        ),
        (
            "localize",
            {"image": ("a", png(8_000, 2, 0))},
            413,
            "a (8000x8000): 64,000,000 pixels",
        ),
        ("localize", {"image": ("a", png(20, 2, 0))}, 400, "a: not a readable image"),
        ("localize", {"image": "IMAGE", "camera": ("c", b"{")}, 400, "camera: "),
        ("localize", {"image": "IMAGE", "camera": ("c", b"PK")}, 400, "not a text"),
        ("localize", {"image": "IMAGE", "camera": ("c", b"[" * 60_000)}, 400, "camera"),
        (
            "localize",
            {"image": "IMAGE", "camera": ("c", b" " * 1_000_001)},
            413,
            "camera",
        ),
        ("calibrations", {}, 422, "images: Field required"),
        ("calibrations", {"images": ("a", b"x")}, 400, "a: not a readable image"),
        (
            "calibrations",
            {"images": "IMAGE", "robot_poses": ("p.csv", b"a,b\n1,2")},
            400,
            "robot_",
        ),
        ("calibrations", {"images": "IMAGE", "mount": "table"}, 422, "mount"),
        ("check", {"images": "IMAGE"}, 422, "calibration: Field required"),
        (
            "check",
            {"images": "IMAGE", "calibration": ("c", b"[]")},
            400,
            "'evercal-calibration'",
        ),
        ("scenes", {}, 405, "Method Not Allowed"),
        ("nowhere", {}, 404, "Not Found"),
        ("scenes/..%2F..%2Fetc", {}, 404, "Not Found"),
    ],
)
def test_refusals_are_one_line(hall_service, image, path, parts, status, message):
    for name in [name for name, value in parts.items() if value == "IMAGE"]:
        parts = {**parts, name: image}
    code, error = hall_service.post(f"/{path}", **parts).refusal
    assert code == status
    assert message in error
    assert "/tmp" not in error


def test_limits_of_images_and_of_the_queue(serve, hall_store, image):
    limits = RequestBounds(images=2, pixels=1000, held_bytes=10 * image.stat().st_size)
    with serve(hall_store, limits=limits) as service:
        got = service.post("/calibrations", images=[image] * 3)
        assert got.refusal == (413, "images: 3 given; at most 2")
        got = service.post("/localize", image=image)
        status, message = got.refusal
        assert status == 413
        assert message.startswith("hall.png (320x240): 76,800 pixels, at most 1,000")
        got = service.post("/localize", image=("a.png", bytes(limits.held_bytes)))
        assert got.refusal == (429, "too many requests wait; try again")
    with serve(hall_store, limits=RequestBounds(requests=0)) as service:
        assert service.post("/localize", image=image).status == 429
    with serve(hall_store, limits=RequestBounds(request_pixels=100_000)) as service:
        got = service.post("/calibrations", images=[image] * 2)
        message = "images: 153,600 pixels in all; at most 100,000"
        assert got.refusal == (413, message)


def test_other_fields_of_a_form_are_refused_by_name(hall_service, image):
    for name in ("camra", "Image", "x" * 500):
        got = hall_service.post("/localize", image=image, **{name: image})
        known = "is no field of this form; it has image, camera, scene"
        assert got.refusal == (400, f"{name[:100]!r} {known}")
    got = hall_service.post("/localize", image=[image] * 2)
    assert got.refusal == (400, "image: given 2 times; give it once")
    mounts = ["eye_to_hand", "eye_in_hand"]
    got = hall_service.post("/calibrations", images=image, mount=mounts)
    assert got.refusal == (400, "mount: given 2 times; give it once")


def test_the_page_comes_from_the_service_alone_and_sends_the_token(
    hall_service, serve, hall_store
):
    import re

    got = hall_service.get("/")
    assert (got.status, got.headers["location"]) == (307, "docs")
    page = hall_service.get("/docs")
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    addresses = re.findall(
        r"""(?:href|src|url)[=:]\s*["']([^"']+)""", page.body.decode()
    )
    assert len(addresses) == 4
    for address in addresses:
        assert "//" not in address
        assert hall_service.get(f"/{address}").status == 200
    paths = hall_service.get("/openapi.json").json["paths"]
    assert "security" not in paths["/check"]["post"]
    with serve(hall_store, token="a-token-of-16-characters") as service:
        assert service.get("/pages/swagger-ui.css").status == 200
        asked = service.get("/openapi.json").json
        assert asked["paths"]["/check"]["post"]["security"] == [{"HTTPBearer": []}]


def test_stream_of_frames(hall_service, image, hall):
    from websockets.sync.client import connect

    camera = json.dumps(hall.test[7].camera.to_dict())
    row = hall_service.post("/localize", image=image).json
    with connect(
        hall_service.url.replace("http", "ws") + "/track", max_size=None
    ) as socket:
        socket.send(image.read_bytes())
        first = json.loads(socket.recv())
        assert {**first, **dict.fromkeys(("path", "ms"))} == {
            **first, **row, **dict.fromkeys(("path", "ms"))
        }  # fmt: skip
        assert first["state"] == "relocalized"
        socket.send(b"no image")
        assert json.loads(socket.recv())["error"].startswith(
            "frame 1: not a readable image"
        )
        socket.send(camera)
        for number in (2, 3):
            socket.send(image.read_bytes())
            assert json.loads(socket.recv())["path"] == f"frame {number}"
        socket.send("{")
        socket.send(image.read_bytes())
        assert json.loads(socket.recv())["error"].startswith("camera: ")


def test_fields_that_a_page_sends_empty_are_not_given(hall_service, image):
    empty = {"camera": "", "scene": ""}
    got = hall_service.post("/localize", image=image, **empty)
    assert got.json["status"] == "ok"
    empty |= {"robot_poses": "", "convention": "", "mount": ""}
    got = hall_service.post("/calibrations", images=image, **empty)
    assert got.json["mount"] == "eye_to_hand"
