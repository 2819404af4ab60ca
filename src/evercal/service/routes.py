"""The endpoints. Every request is answered from one state of the map."""

import json
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import (
    APIRouter,
    Depends,
    File,
    Form,
    Request,
    Response,
    UploadFile,
    WebSocket,
)
from fastapi.responses import PlainTextResponse, RedirectResponse
from prometheus_client import generate_latest
from starlette.websockets import WebSocketDisconnect

from evercal.bounds import RequestBounds
from evercal.calibration import drift
from evercal.calibration.from_images import Images, calibrate
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.reports.answers import Answer, answer_row, check_record, unit_known
from evercal.reports.track_files import track_row
from evercal.service.desk import Desk
from evercal.service.guard import Metrics
from evercal.service.limits import (
    Sent,
    calibration_of,
    camera_of,
    decoded,
    poses_of,
)
from evercal.service.live_map import LiveMap

router = APIRouter()
CameraFile = Annotated[
    UploadFile | None,
    File(description="Intrinsics: JSON, YAML or a 3x3 matrix as text."),
]
_NAME = 100
"""Characters of a file name that are kept."""


@dataclass(frozen=True)
class Service:
    """What the endpoints share."""

    live: LiveMap
    desk: Desk
    limits: RequestBounds
    metrics: Metrics


def service_of(request: Request | WebSocket) -> Service:
    """The service that a request came to."""
    return request.app.state.service


def form(one: str, many: str = "") -> Any:
    """Refuse other fields of a form, and all but `many` of them more than once."""
    known = [*one.split(), *many.split()]

    async def check(request: Request) -> None:
        given = Counter(key for key, _ in (await request.form()).multi_items())
        for name, count in given.items():
            if name not in known:
                fields = ", ".join(known)
                raise InputError(
                    f"{name[:_NAME]!r} is no field of this form; it has {fields}"
                )
            if count > 1 and name not in many.split():
                raise InputError(f"{name}: given {count} times; give it once")

    return Depends(check)


@router.get("/", include_in_schema=False)
async def index() -> Response:
    """The page of the service."""
    return RedirectResponse("docs")


@router.get("/health")
async def health(request: Request) -> dict[str, Any]:
    """Whether the service answers."""
    return {"status": "ok", "scenes": len(service_of(request).live.current.scenes)}


@router.get("/scenes")
async def scenes(request: Request) -> dict[str, Any]:
    """Names of the scenes, in order of learning."""
    return {"scenes": list(service_of(request).live.current.scenes)}


@router.post("/localize", dependencies=[form("image camera")])
async def localize(
    request: Request, image: UploadFile, camera: CameraFile = None
) -> dict[str, Any]:
    """Estimate the camera pose of one image: the row of `evercal localize --json`."""
    service = service_of(request)
    name = _name(image, "image")
    data = await image.read()
    intrinsics = await _content(camera)

    def work() -> dict[str, Any]:
        localizer = service.live.current.localizer
        began = time.perf_counter()
        pixels = decoded(data, name, service.limits)
        estimate = localizer.localize(pixels, _camera(intrinsics, pixels))
        milliseconds = 1000 * (time.perf_counter() - began)
        known = unit_known(localizer, estimate.scene)
        return answer_row(Answer(Path(name), estimate, milliseconds, known))

    row = await service.desk.run(work)
    service.metrics.answers.labels(row["status"]).inc()
    return row


Shots = Annotated[list[UploadFile], File(description="Image files, all of one camera.")]


async def _sent(request: Request, images: list[UploadFile]) -> Sent:
    files = [
        (_name(image, f"image {i}"), await image.read())
        for i, image in enumerate(images)
    ]
    return Sent(files, service_of(request).limits)


@router.post("/calibrations", dependencies=[form("camera robot_poses mount", "images")])
async def calibrations(
    request: Request,
    images: Shots,
    camera: CameraFile = None,
    robot_poses: Annotated[
        UploadFile | None,
        File(description="base_from_gripper of every image: a table as text, or JSON."),
    ] = None,
    mount: Annotated[Literal["eye_to_hand", "eye_in_hand"] | None, Form()] = None,
) -> dict[str, Any]:
    """Calibrate a camera from its images: the calibration file."""
    service = service_of(request)
    sent = await _sent(request, images)
    table = await _content(robot_poses)
    intrinsics = await _content(camera)
    ending = "" if robot_poses is None else Path(robot_poses.filename or "").suffix

    def work() -> dict[str, Any]:
        sent.check_pixels()
        poses = None if table is None else poses_of(table, ending, sent.names)
        given = Images(sent, sent.camera(intrinsics), poses)
        return calibrate(service.live.current.localizer, given, mount).to_dict()

    return await service.desk.run(work)


@router.post("/check", dependencies=[form("camera calibration", "images")])
async def check(
    request: Request,
    images: Shots,
    calibration: Annotated[
        UploadFile, File(description="The calibration file of the camera.")
    ],
    camera: CameraFile = None,
) -> dict[str, Any]:
    """Test whether a fixed camera has moved: the object of `evercal check --json`."""
    service = service_of(request)
    sent = await _sent(request, images)
    reference = await calibration.read()
    intrinsics = await _content(camera)

    def work() -> dict[str, Any]:
        stated = calibration_of(reference)
        sent.check_pixels()
        given = sent.camera(intrinsics)
        return check_record(
            drift.check(service.live.current.localizer, sent, stated, given)
        )

    return await service.desk.run(work)


def _name(file: UploadFile, default: str) -> str:
    return (file.filename or default)[-_NAME:]


async def _content(file: UploadFile | None) -> bytes | None:
    return None if file is None else await file.read()


def _camera(intrinsics: bytes | None, image: np.ndarray) -> Camera | None:
    return None if intrinsics is None else camera_of(intrinsics, image.shape[1::-1])


@router.get("/metrics", response_class=PlainTextResponse)
async def metrics(request: Request) -> Response:
    """Counters for Prometheus."""
    service = service_of(request)
    service.metrics.scenes.set(len(service.live.current.scenes))
    service.metrics.waiting.set(service.desk.waiting)
    text = generate_latest(service.metrics.registry)
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")


@router.websocket("/track")
async def track(socket: WebSocket) -> None:
    """Frames in, rows out: each binary message is an image file, each answer a JSON row.

    Rows have the state of the tracking (`tracking`, `relocalized`, `lost`). A text message holds
    the intrinsics of the frames that follow, as `camera` of `/localize`. A frame that cannot be
    used is answered with `{"error": ...}`.
    """
    service = service_of(socket)
    intrinsics = None
    number = 0
    tracker: Tracker | None = None
    tracked: tuple[Localizer, bytes | None] | None = None

    def row(data: bytes, name: str) -> dict[str, Any]:
        nonlocal tracker, tracked
        localizer = service.live.current.localizer
        image = decoded(data, name, service.limits)
        # The map or the camera changed.
        if tracker is None or tracked != (
            localizer,
            intrinsics,
        ):
            tracker = Tracker(localizer, _camera(intrinsics, image))
            tracked = (localizer, intrinsics)
        frame = tracker.track(image, time.monotonic())
        return track_row(frame, name, unit_known(localizer, frame.estimate.scene))

    await socket.accept()
    with suppress(WebSocketDisconnect):
        while (message := await socket.receive())["type"] != "websocket.disconnect":
            if message.get("text") is not None:
                intrinsics = message["text"].encode()
                continue
            name = f"frame {number}"
            number = number + 1
            try:
                answer = await service.desk.run(row, message["bytes"], name)
            except InputError as error:
                answer = {"path": name, "error": one_line(error)}
            await socket.send_text(json.dumps(answer, allow_nan=False))


def one_line(error: object) -> str:
    """A message without line breaks."""
    return " ".join(str(error).split())
