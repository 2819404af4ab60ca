"""The 3D view of a large map in a browser: time until all is there, bytes, frames per second."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from benchmarks.browser import CHROMIUM, chromium
from evercal import SE3, Map
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import SceneMap
from evercal.service.viewer.page import Page, ViewOptions

_COUNT = "window.drawn = 0; (function next() { window.drawn++; requestAnimationFrame(next) })()"


def run(
    store: Path,
    keyframes: int = 100,
    seconds: float = 20.0,
    browser: str | None = CHROMIUM,
    out: Path = Path("runs/view.json"),
) -> None:
    """Show a map whose keyframes are repeated at other places.

    Args:
        store: A learned map; its first scene is enlarged.
        keyframes: Keyframes of the large map.
        seconds: Time in which frames are counted while the view is turned.
        browser: Path of a Chromium.
        out: File for the numbers, JSON.
    """
    opened = Map.open(store).localizer
    scene = enlarged(opened.contents.scenes[0], keyframes)
    began = time.perf_counter()
    page = Page(Localizer(replace(opened.contents, scenes=[scene])), ViewOptions(port=0))
    row: dict[str, Any] = {"keyframes": keyframes, "landmarks": scene.landmarks}
    row["page made, s"] = time.perf_counter() - began
    try:
        with chromium(browser) as started:
            row |= _visited(started, page.url, seconds)
    finally:
        page.close()
    row["load average"] = os.getloadavg()[0]
    print(tabulate([row], headers="keys", floatfmt=".1f"))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(row, indent=1))


def enlarged(scene: SceneMap, keyframes: int) -> SceneMap:
    """The scene with its keyframes, and their landmarks, repeated on a grid of two metres."""
    taken = scene.keyframes.take(np.arange(keyframes) % len(scene.keyframes))
    copy = np.arange(keyframes) // len(scene.keyframes)
    away = SE3.from_translation(np.stack([2 * (copy % 4), 2 * (copy // 4), 0 * copy], -1))
    moved = replace(taken, base_from_camera=away @ taken.base_from_camera)
    return replace(scene, keyframes=moved)


def _visited(browser: Any, url: str, seconds: float) -> dict[str, float]:
    """Open the page and turn the view."""
    visit = browser.new_page(viewport={"width": 1280, "height": 800})
    received: list[tuple[float, int]] = []

    def connected(websocket: Any) -> None:
        websocket.on("framereceived", lambda data: received.append((time.time(), len(data))))

    visit.on("websocket", connected)
    began = time.time()
    visit.goto(url)
    visit.wait_for_selector("canvas", timeout=300_000)
    canvas = time.time() - began
    visit.get_by_text("landmarks").first.wait_for(timeout=300_000)
    while time.time() - received[-1][0] < 5:
        visit.wait_for_timeout(500)
    complete = received[-1][0] - began
    visit.evaluate(_COUNT)
    start = time.time()
    visit.mouse.move(400, 400)
    visit.mouse.down()
    while (passed := time.time() - start) < seconds:
        visit.mouse.move(400 + 200 * np.sin(passed), 400)
    rate = visit.evaluate("window.drawn") / (time.time() - start)
    return {
        "canvas, s": canvas,
        "all received, s": complete,
        "MB": sum(size for _, size in received) / 1e6,
        "frames per second": rate,
    }
