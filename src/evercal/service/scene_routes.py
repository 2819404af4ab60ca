"""Endpoints that change the map: a recording is learned as a job, a scene is removed."""

import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from evercal.errors import InputError
from evercal.map import Map
from evercal.mapping.memory_budget import MemoryBudget
from evercal.recordings.held_out import checked_name
from evercal.service import learning
from evercal.service.jobs import QueueFullError
from evercal.service.limits import TooLargeError, json_of
from evercal.service.routes import Service, service_of
from evercal.storage.archive import ArchiveLimits, check_archive

router = APIRouter()
_ASKED = {
    "type": "object",
    "required": ["path"],
    "properties": {key: {"type": "string"} for key in ("path", "name", "memory")},
}
_MOST_JSON = 64 * 1024


@router.post(
    "/scenes",
    status_code=202,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/zip": {"schema": {"type": "string", "format": "binary"}},
                "application/json": {"schema": _ASKED},
            },
        }
    },
)
async def learn(
    request: Request, response: Response, name: str | None = None, memory: str | None = None
) -> dict[str, Any]:
    """Learn a recording in another process; the answer is a job.

    Send a zip archive of the recording, or `{"path": ...}` below the folder that the service was
    started with. `name` and `memory` mean the same as for `evercal learn`.
    """
    service = service_of(request)
    if len(service.jobs.pending) > service.limits.jobs:
        raise QueueFullError(f"{service.limits.jobs} recordings wait; try again")
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind == "application/json":
        asked = json_of(await _body(request), "body", _strings)
        recording, is_archive = _below(service, asked), False
        name, memory = asked.get("name", name), asked.get("memory", memory)
        _require_usable(service, name, memory)
    elif kind == "application/zip":
        _require_usable(service, name, memory)
        recording, is_archive = await _uploaded(request, service), True
    else:
        raise HTTPException(415, "send application/zip or application/json")
    wanted = learning.Request(
        service.live.path,
        recording,
        is_archive,
        name,
        memory,
        service.device,
        service.limits.unpacked_bytes,
    )
    try:
        job = service.jobs.add(wanted)
    except QueueFullError:
        if is_archive:
            recording.unlink(missing_ok=True)
        raise
    response.headers["location"] = f"/jobs/{job.id}"
    return job.to_dict()


def _strings(value: object) -> dict[str, str]:
    if not isinstance(value, dict) or not isinstance(value.get("path"), str):
        raise InputError('body: give {"path": ...}')
    if not all(isinstance(v, str) for v in value.values()):
        raise InputError("body: path, name and memory are strings")
    return value


def _require_usable(service: Service, name: str | None, memory: str | None) -> None:
    MemoryBudget.parse(memory)
    if name is None:
        return
    taken = {*service.live.current.scenes, *(job.name for job in service.jobs.pending)}
    if checked_name(name) in taken:
        raise HTTPException(409, f"scene {name!r}: a scene of this name exists")


async def _body(request: Request) -> bytes:
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_JSON:
            raise TooLargeError(f"body: more than {_MOST_JSON} bytes")
    return body


def _below(service: Service, asked: dict[str, str]) -> Path:
    """The recording at a path below the allowed folder."""
    if service.recordings is None:
        raise HTTPException(403, "paths are refused: the service was started without --recordings")
    root = service.recordings.resolve()
    try:
        path = (root / asked["path"]).resolve()
        exists = path.exists()
    except (OSError, ValueError):
        raise InputError("path: cannot be a path") from None
    if not path.is_relative_to(root) or path == root:
        raise HTTPException(403, "path: lies outside the folder of recordings")
    if not exists:
        raise HTTPException(404, "path: no such recording")
    return path


async def _uploaded(request: Request, service: Service) -> Path:
    """The archive in a request, written to disk as it arrives and checked."""
    path = service.uploads / f"{secrets.token_hex(8)}.zip"
    try:
        with open(path, "xb") as file:
            async for chunk in request.stream():
                await run_in_threadpool(file.write, chunk)
        limits = ArchiveLimits(service.limits.unpacked_bytes)
        await run_in_threadpool(check_archive, path, limits)
    except BaseException as error:
        with suppress(OSError):
            path.unlink()
        if isinstance(error, InputError):
            raise InputError(str(error).replace(str(path), "archive")) from None
        raise
    return path


@router.get("/jobs/{key}")
async def job(request: Request, key: str) -> dict[str, Any]:
    """State of a job: `queued`, `learning`, `done` or `failed`."""
    found = service_of(request).jobs.get(key)
    if found is None:
        raise HTTPException(404, "no such job")
    return found.to_dict()


@router.delete("/scenes/{name}", status_code=204)
async def remove(request: Request, name: str) -> Response:
    """Remove a scene."""
    service = service_of(request)
    if name not in service.live.current.scenes:
        raise HTTPException(404, f"scene {name!r}: the map has no scene of this name")

    def work() -> None:
        try:
            Map.open(service.live.path, device="cpu").remove(name)
        except InputError as error:  # another process writes into the map
            raise HTTPException(409, str(error)) from None
        service.live.refresh()

    await run_in_threadpool(work)
    return Response(status_code=204)
