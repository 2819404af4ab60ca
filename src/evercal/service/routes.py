"""The endpoints. Every request is answered from one state of the map."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, File, Form, Request, Response, UploadFile, WebSocket
from fastapi.responses import PlainTextResponse
from prometheus_client import generate_latest
from starlette.websockets import WebSocketDisconnect

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.reports.answers import check_record, unit_known
from evercal.reports.track_files import track_row
from evercal.service.desk import Desk
from evercal.service.guard import Metrics
from evercal.service.jobs import Jobs, QueueFullError
from evercal.service.limits import Limits, TooLargeError, camera_of, decoded, json_of, poses_of
from evercal.service.live_map import LiveMap

router = APIRouter()
Images = Annotated[list[UploadFile], File(description="Image files, all of one camera.")]
CameraFile = Annotated[
    UploadFile | None, File(description="Intrinsics: JSON, YAML or a 3x3 matrix as text.")
]


@dataclass(frozen=True)
class Service:
    """What the endpoints share."""

    live: LiveMap
    jobs: Jobs
    desk: Desk
    limits: Limits
    metrics: Metrics
    uploads: Path
    """Folder for archives that wait to be learned."""
    recordings: Path | None = None
    """Folder whose recordings may be learned by their path."""
    device: str = "auto"


def service_of(request: Request | WebSocket) -> Service:
    """The service that a request came to."""
    return request.app.state.service


@router.get("/health")
async def health(request: Request) -> dict[str, Any]:
    """Whether the service answers."""
    return {"status": "ok", "scenes": len(service_of(request).live.current.scenes)}


@router.get("/scenes")
async def scenes(request: Request) -> dict[str, Any]:
    """Names of the scenes, in order of learning."""
    return {"scenes": list(service_of(request).live.current.scenes)}


@router.post("/localize")
async def localize(
    request: Request, image: UploadFile, camera: CameraFile = None
) -> dict[str, Any]:
    """Estimate the camera pose of one image: the row of `evercal localize --json`."""
    service, name = service_of(request), image.filename or "image"
    lens = None if camera is None else await camera.read()
    row = await service.desk.run(_located, service, await image.read(), name, lens)
    service.metrics.answers.labels(row["status"]).inc()
    return row


def _located(service: Service, data: bytes, name: str, lens: bytes | None) -> dict[str, Any]:
    def read() -> tuple[np.ndarray, Camera | None]:
        image = decoded(data, name, service.limits)
        return image, _camera(lens, image)

    return service.live.row(read, name)


def _camera(lens: bytes | None, image: np.ndarray) -> Camera | None:
    return None if lens is None else camera_of(lens, (image.shape[1], image.shape[0]))


@router.post("/calibrations")
async def calibrations(
    request: Request,
    images: Images,
    camera: CameraFile = None,
    robot_poses: Annotated[
        UploadFile | None,
        File(description="base_from_gripper of every image: a table as text, or JSON."),
    ] = None,
    mount: Annotated[Literal["eye_to_hand", "eye_in_hand"] | None, Form()] = None,
) -> dict[str, Any]:
    """Calibrate a camera from its images: the calibration file."""
    service = service_of(request)
    files, lens = await _files(service, images), None if camera is None else await camera.read()
    table = None if robot_poses is None else await robot_poses.read()
    ending = "" if robot_poses is None else Path(robot_poses.filename or "").suffix

    def work() -> dict[str, Any]:
        from evercal.calibration.from_images import Images as Given
        from evercal.calibration.from_images import calibrate

        pixels, lens_of_all = _decoded(service, files, lens)
        poses = None if table is None else poses_of(table, ending, [name for name, _ in files])
        given = Given(pixels, lens_of_all, poses)
        return calibrate(service.live.current.localizer, given, mount).to_dict()

    return await service.desk.run(work)


@router.post("/check")
async def check(
    request: Request,
    images: Images,
    calibration: Annotated[UploadFile, File(description="The calibration file of the camera.")],
    camera: CameraFile = None,
) -> dict[str, Any]:
    """Test whether a fixed camera has moved: the object of `evercal check --json`."""
    service, reference = service_of(request), await calibration.read()
    files, lens = await _files(service, images), None if camera is None else await camera.read()

    def work() -> dict[str, Any]:
        from evercal.calibration.calibration import Calibration
        from evercal.calibration.drift import check

        stated = json_of(reference, "calibration", Calibration.from_dict)
        pixels, lens_of_all = _decoded(service, files, lens)
        return check_record(check(service.live.current.localizer, pixels, stated, lens_of_all))

    return await service.desk.run(work)


async def _files(service: Service, images: list[UploadFile]) -> list[tuple[str, bytes]]:
    if len(images) > service.limits.images:
        raise TooLargeError(f"images: {len(images)} given; at most {service.limits.images}")
    return [(image.filename or f"image {i}", await image.read()) for i, image in enumerate(images)]


def _decoded(
    service: Service, files: list[tuple[str, bytes]], lens: bytes | None
) -> tuple[list[tuple[str, np.ndarray]], Camera | None]:
    pixels = [(name, decoded(data, name, service.limits)) for name, data in files]
    return pixels, _camera(lens, pixels[0][1])


@router.get("/metrics", response_class=PlainTextResponse)
async def metrics(request: Request) -> Response:
    """Counters for Prometheus."""
    service = service_of(request)
    gauges = service.metrics.gauges
    gauges["scenes"].set(len(service.live.current.scenes))
    gauges["waiting_images"].set(service.desk.waiting)
    gauges["pending_jobs"].set(len(service.jobs.pending))
    text = generate_latest(service.metrics.registry)
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")


@router.websocket("/track")
async def track(socket: WebSocket) -> None:
    """Frames in, rows out: each binary message is an image file, each answer a JSON row.

    Rows have the state of the tracking (`tracking`, `relocalized`, `lost`). A text message holds
    the intrinsics of the frames that follow, as `camera` of `/localize`. A frame that cannot be
    used is answered with `{"error": ...}`.
    """
    service, lens, number = service_of(socket), None, 0
    followed = Followed(service)
    await socket.accept()
    try:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if message.get("text") is not None:
                lens = message["text"].encode()
                continue
            name, number = f"frame {number}", number + 1
            try:
                row = await service.desk.run(followed.row, message["bytes"], name, lens)
            except (InputError, QueueFullError) as error:
                row = {"path": name, "error": one_line(error)}
            await socket.send_text(json.dumps(row, allow_nan=False))
    except WebSocketDisconnect:
        return


class Followed:
    """A stream of frames; it is tracked anew when the map or the intrinsics change."""

    def __init__(self, service: Service):
        self._service = service
        self._of: tuple[Localizer, bytes | None] | None = None
        self._tracker: Tracker | None = None

    def row(self, data: bytes, name: str, lens: bytes | None) -> dict[str, Any]:
        """The row of the next frame, with the state of the tracking."""
        localizer = self._service.live.current.localizer
        image = decoded(data, name, self._service.limits)
        if self._tracker is None or self._of != (localizer, lens):
            self._tracker = Tracker(localizer, _camera(lens, image))
            self._of = (localizer, lens)
        frame = self._tracker.track(image, time.monotonic())
        return track_row(frame, name, unit_known(localizer, frame.estimate.scene))


def one_line(error: object) -> str:
    """A message without line breaks."""
    return " ".join(str(error).split())
