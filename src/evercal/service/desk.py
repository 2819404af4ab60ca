"""`Desk`: a few threads that locate images."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from evercal.processes import cores

Result = TypeVar("Result")


class Desk:
    """Works on images in threads, one image for each."""

    def __init__(self) -> None:
        self.waiting = 0
        self._pool = ThreadPoolExecutor(cores(), "image")

    async def run(self, work: Callable[..., Result], *args: Any) -> Result:
        """The result of a function, called in a thread."""
        self.waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(
                self._pool, work, *args
            )
        finally:
            self.waiting -= 1

    def close(self) -> None:
        """Wait for the images at work."""
        self._pool.shutdown()
