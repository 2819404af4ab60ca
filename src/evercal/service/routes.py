"""The endpoints. Every request is answered from one state of the map."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_args

from fastapi import (
    APIRouter,
    Depends,
    File,
    Form,
    Query,
    Request,
    Response,
    WebSocket,
)
from fastapi.responses import RedirectResponse
from prometheus_client import generate_latest
from pydantic import WithJsonSchema
from pydantic_core import to_json
from starlette.requests import HTTPConnection

from evercal.bounds import RequestBounds
from evercal.calibration import drift, from_images
from evercal.calibration.image_source import Images
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.reports.answers import Answer, answer_row, check_record, unit_known
from evercal.reports.track_files import track_row
from evercal.robot.mount import MountName
from evercal.service.desk import Check, Desk
from evercal.service.guard import Metrics
from evercal.service.limits import (
    Sent,
    calibration_of,
    camera_of,
    decoded,
    poses_of,
)
from evercal.service.live_map import LiveMap
from evercal.service.schemas import (
    FILE,
    CalibrationFile,
    CameraShift,
    Estimate,
    Health,
    Problem,
    SceneNames,
    Upload,
)
from evercal.service.stream import Frame, Stream
from evercal.typing import JsonObject, Strings

router = APIRouter(
    generate_unique_id_function=lambda route: route.name,
    responses={"4XX": {"model": Problem}, "5XX": {"model": Problem}},
)
# Generators of clients would send an optional file that is null as text.
OptionalFile = Annotated[Upload | None, WithJsonSchema(FILE)]
CameraFile = Annotated[
    OptionalFile,
    File(description="Intrinsics: JSON, YAML or a 3x3 matrix as text."),
]
PosesFile = Annotated[
    OptionalFile,
    File(description="base_from_gripper of every image: a table as text, or JSON."),
]
Scenes = Annotated[
    Strings,
    Form(
        default_factory=tuple,
        examples=[[]],
        description="Names of scenes; others are not considered.",
    ),
]
Convention = Annotated[
    str,
    Form(
        default_factory=str,
        examples=[""],
        description="Of the numbers in `robot_poses`, such as `kuka` or `ur`.",
    ),
]
Shots = Annotated[list[Upload], File(description="Image files, all of one camera.")]
_SHOTS = ("images", "camera", "robot_poses", "convention")
"""Fields of images that are fused."""
_NAME = 100
"""Characters of a file name that are kept."""


@frozen
class Service:
    """What the endpoints share."""

    live: LiveMap
    desk: Desk
    limits: RequestBounds
    metrics: Metrics


async def service_of(connection: HTTPConnection) -> Service:
    """The service that a request came to."""
    return connection.app.state.service


Asked = Annotated[Service, Depends(service_of)]


def form(*known: str) -> Any:
    """Refuse other fields of a form, and all but `images` and `scene` more than once."""

    async def check(request: Request) -> None:
        parts = await request.form()
        for name in parts:
            if name not in known:
                fields = ", ".join(known)
                raise InputError(
                    f"{name[:_NAME]!r} is no field of this form; it has {fields}"
                )
            count = len(parts.getlist(name))
            if count > 1 and name not in ("images", "scene"):
                raise InputError(f"{name}: given {count} times; give it once")

    return Depends(check)


@router.get("/", include_in_schema=False)
async def index() -> Response:
    """The page of the service."""
    return RedirectResponse("docs")


@router.get(
    "/health",
    tags=["service"],
    response_model=Health,
    responses={503: {"model": Health, "description": "The map cannot be read."}},
)
async def health(service: Asked) -> Response:
    """Whether the service answers, and whether it can read the map."""
    scenes = len(service.live.current.scenes)
    status = 200
    content = {"status": "ok", "scenes": scenes}
    if service.live.fault is not None:
        content["status"] = "the map cannot be read; its last state is served"
        if not scenes:
            status = 503
            content["status"] = "the map cannot be read"
    return _json(content, status)


@router.get("/scenes", tags=["service"], response_model=SceneNames)
async def scenes(service: Asked) -> Response:
    """Names of the scenes, in order of learning."""
    return _json({"scenes": service.live.current.scenes})


@router.post(
    "/localize",
    tags=["images"],
    response_model=Estimate,
    dependencies=[form("image", "camera", "scene")],
)
async def localize(
    service: Asked,
    request: Request,
    image: Annotated[Upload, File(description="An image file.")],
    scene: Scenes,
    camera: CameraFile = None,
) -> Response:
    """Estimate the camera pose of one image: the row of `evercal localize --json`."""
    name = _name(image, "image")
    data = await image.read()
    intrinsics = await _content(camera)

    def work(_: Check) -> JsonObject:
        localizer = service.live.within(scene)
        began = time.perf_counter()
        pixels = decoded(data, name, service.limits)
        estimate = localizer.localize(
            pixels, camera_of(intrinsics, pixels.shape[1::-1])
        )
        milliseconds = 1000 * (time.perf_counter() - began)
        known = unit_known(localizer, estimate.scene)
        return answer_row(Answer(Path(name), estimate, milliseconds, known))

    row = await service.desk.run(work, request)
    service.metrics.answers.labels(row["status"]).inc()
    return _json(row)


async def _decode(
    service: Asked,
    images: Shots,
    convention: Convention,
    camera: CameraFile = None,
    robot_poses: PosesFile = None,
) -> Callable[[Check], Images]:
    """A function that decodes the images of a request, with their camera and robot poses."""
    contents = []
    for i, file in enumerate(images):
        contents.append((_name(file, f"image {i}"), await file.read()))
    sent = Sent(contents, service.limits)
    intrinsics = await _content(camera)
    table = await _content(robot_poses)

    def decode(check: Check) -> Images:
        sent.before_image = check
        sent.check_pixels()
        poses = None
        if robot_poses and table is not None:
            ending = Path(robot_poses.filename or "").suffix
            poses = poses_of(table, ending, sent.names, convention or None)
        return Images(sent, sent.camera(intrinsics), poses)

    return decode


Decode = Annotated[Callable[[Check], Images], Depends(_decode)]


@router.post(
    "/calibrations",
    tags=["images"],
    response_model=CalibrationFile,
    dependencies=[form(*_SHOTS, "scene", "mount")],
)
async def calibrate(
    service: Asked,
    request: Request,
    decode: Decode,
    scene: Scenes,
    mount: Annotated[
        MountName | None,
        Form(description="Beside the arm or on the gripper; else by the images."),
        WithJsonSchema({"type": "string", "enum": get_args(MountName)}),
    ] = None,
) -> Response:
    """Calibrate a camera from its images: the calibration file."""

    def work(check: Check) -> JsonObject:
        given = decode(check)
        scenes = service.live.within(scene)
        return from_images.calibrate(scenes, given, mount).to_dict()

    return _json(await service.desk.run(work, request))


@router.post(
    "/check",
    tags=["images"],
    response_model=CameraShift,
    dependencies=[form(*_SHOTS, "scene", "calibration")],
)
async def check(
    service: Asked,
    request: Request,
    decode: Decode,
    scene: Scenes,
    calibration: Annotated[
        Upload, File(description="The calibration file of the camera.")
    ],
) -> Response:
    """Test whether a fixed camera has moved: the object of `evercal check --json`."""
    content = await calibration.read()

    def work(check: Check) -> JsonObject:
        reference = calibration_of(content)
        given = decode(check)
        shift = drift.check(
            service.live.within(scene),
            given.images,
            reference,
            given.camera,
            base_from_gripper=given.base_from_gripper,
        )
        return check_record(shift)

    return _json(await service.desk.run(work, request))


def _json(content: JsonObject, status: int = 200) -> Response:
    # Faster than JSONResponse; null for what is not finite.
    text = to_json(content, inf_nan_mode="null")
    return Response(text, status, media_type="application/json")


def _name(file: Upload, default: str) -> str:
    return (file.filename or default)[-_NAME:]


async def _content(file: Upload | None) -> bytes | None:
    if not file:
        return None
    return await file.read()


@router.get(
    "/metrics",
    tags=["service"],
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(service: Asked) -> Response:
    """Counters for Prometheus."""
    service.metrics.scenes.set(len(service.live.current.scenes))
    service.metrics.waiting.set(service.desk.waiting)
    text = generate_latest(service.metrics.registry)
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")


@router.websocket("/track")
async def track(
    socket: WebSocket,
    service: Asked,
    newest: bool = False,
    scene: Annotated[Strings, Query()] = (),
) -> None:
    """Frames in, rows out: each binary message is an image file, each answer a JSON row.

    Rows have the state of the tracking (`tracking`, `relocalized`, `lost`). A text message holds
    the intrinsics of the frames that follow, as `camera` of `/localize`. A frame that cannot be
    used is answered with `{"error": ...}`. Frames wait in order; with `newest` only the newest
    waits, and the others are dropped. With `scene`, frames are located in these scenes only.
    """
    tracker: Tracker | None = None
    tracked: tuple[Localizer, bytes] | None = None

    def locate(frame: Frame, name: str) -> JsonObject:
        nonlocal tracker, tracked
        localizer = service.live.localizer
        image = decoded(frame.data, name, service.limits)
        # The map or the camera changed.
        if not tracker or tracked != (localizer, frame.intrinsics):
            camera = camera_of(frame.intrinsics or None, image.shape[1::-1])
            tracker = Tracker(service.live.within(scene), camera)
            tracked = (localizer, frame.intrinsics)
        located = tracker.track(image, time.monotonic())
        known = unit_known(localizer, located.estimate.scene)
        return track_row(located, name, known)

    async def row(frame: Frame) -> JsonObject:
        name = f"frame {frame.number}"
        try:
            return await service.desk.run(lambda _: locate(frame, name))
        except InputError as error:
            service.live.failed(error)
            return {"path": name, "error": one_line(error)}

    await Stream(socket, service.limits.stream_bytes, newest).answer(row)


def one_line(error: object) -> str:
    """A message without line breaks."""
    return " ".join(str(error).split())
