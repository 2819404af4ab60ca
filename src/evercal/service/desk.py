"""`Desk`: a few threads that locate images."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from starlette.exceptions import HTTPException
from starlette.requests import Request

from evercal.processes import cores
from evercal.service.guard import STOPPED

Result = TypeVar("Result")
Check = Callable[[], None]
"""Raises if nobody needs the work any more; called before each image."""


class Desk:
    """Works on images in threads, one image for each."""

    def __init__(self) -> None:
        self.waiting = 0
        self._stopped = False
        self._pool = ThreadPoolExecutor(cores(), "image")

    async def run(
        self, work: Callable[[Check], Result], request: Request | None = None
    ) -> Result:
        """The result of work that is done in a thread.

        It is dropped when the client of the request leaves.
        """
        ended = False

        def check() -> None:
            if ended or self._stopped:
                raise HTTPException(503, STOPPED)

        def checked() -> Result:
            check()
            return work(check)

        loop = asyncio.get_running_loop()
        result = loop.run_in_executor(self._pool, checked)
        leaving = None
        first: set[asyncio.Future] = {result}
        if request is not None:
            leaving = loop.create_task(_left(request))
            first.add(leaving)
        self.waiting += 1
        try:
            await asyncio.wait(first, return_when=asyncio.FIRST_COMPLETED)
            if not result.done():
                raise HTTPException(499, "the client has left")
            return result.result()
        finally:
            self.waiting -= 1
            ended = True
            result.cancel()
            if leaving is not None:
                leaving.cancel()

    def stop(self) -> None:
        """Ask all work to end before its next image."""
        self._stopped = True

    def close(self) -> None:
        """Wait for the images at work."""
        self.stop()
        self._pool.shutdown(cancel_futures=True)


async def _left(request: Request) -> None:
    """Wait until the client of a request, whose body has been read, closes the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
