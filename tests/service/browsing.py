"""What the tests of the pages do in a browser."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def visited(browser: Any, url: str) -> Iterator[Any]:
    """A visit of a page without errors of its scripts and requests to other places."""
    visit = browser.new_page(viewport={"width": 1200, "height": 800})
    errors = []
    visit.on("pageerror", lambda error: errors.append(str(error)))
    own = (url, "data:", "blob:")
    visit.on(
        "request", lambda r: None if r.url.startswith(own) else errors.append(r.url)
    )
    try:
        visit.goto(url)
        visit.wait_for_selector("canvas", timeout=120_000)
        yield visit
    finally:  # a page that stays open takes the processor from the next one
        visit.close()
    assert errors == []


def seen_until(visit: Any, text: str, seconds: float = 300) -> None:
    visit.get_by_text(text).first.wait_for(timeout=1000 * seconds)


def click(visit: Any, name: str, role: str = "button") -> None:
    visit.get_by_role(role, name=name, exact=True).click(timeout=300_000)


def shot(visit: Any, name: str) -> bytes:
    """A picture, which is kept where the environment asks for it."""
    # viser's notice that WebGL runs in software
    visit.add_style_tag(content=".mantine-Notifications-root {display: none}")
    time.sleep(2)
    picture = visit.screenshot(timeout=120_000)
    if "PAGE_SCREENSHOTS" in os.environ:
        Path(os.environ["PAGE_SCREENSHOTS"], f"{name}.png").write_bytes(picture)
    return picture
