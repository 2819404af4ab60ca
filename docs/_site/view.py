"""Draw the picture of docs/view.md: python docs/_site/view.py cell.evercal tripod.json IMAGES.

Map and calibration are those of the README; a folder of images is tracked, such as
samples/cell/wrist/images. Needs Chromium and the extras `view` and `dev`.
"""

import io
import sys
import time
from pathlib import Path

from PIL import Image

import evercal
from evercal.service.viewer.page import Page
from tests.chromium import chromium

OUT = Path(__file__).parents[1] / "view.jpg"


def main(store: Path, calibration: Path, images: Path) -> None:
    """Open the page and keep what it shows."""
    page = Page(evercal.Map.open(store).localizer, [calibration])
    try:
        with chromium() as browser:
            visit = browser.new_page(viewport={"width": 1200, "height": 720})
            visit.goto(page.server.url)
            visit.wait_for_selector("canvas", timeout=120_000)
            # viser's notice that WebGL runs in software
            visit.add_style_tag(content=".mantine-Notifications-root {display: none}")
            time.sleep(20)  # all parts have arrived
            page.track(str(images))
            time.sleep(4)
            shot = Image.open(io.BytesIO(visit.screenshot(timeout=120_000)))
            shot.convert("RGB").save(OUT, quality=80)
    finally:
        page.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
