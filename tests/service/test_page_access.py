"""The pages for everybody: a screen reader's rules, a phone, the keyboard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")

from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import MapContents
from evercal.service.studio.steps import STEPS
from evercal.service.viewer.page import Page, ViewOptions
from evercal.service.viewer.text import OWN

from .browsing import PHONE, click, seen_until, studio_of, visited


def findings(visit: Any) -> dict[str, list[str]]:
    """Serious and critical findings of axe: rules, and the elements that break them."""
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed"
    ).Axe()
    answer = axe.run(visit).response["violations"]
    return {
        rule["id"]: [node["html"] for node in rule["nodes"]]
        for rule in answer
        if rule["impact"] in ("serious", "critical")
    }


def test_every_step_of_the_studio_is_accessible(browser: Any, tmp_path: Path) -> None:
    with studio_of(tmp_path) as page, visited(browser, page.url) as (visit, _):
        seen_until(visit, "Images and gripper poses arrive.")
        page.jobs.run("taking a sample", page.studio.take_sample)
        for step in STEPS:
            page.go(step)
            seen_until(visit, f"{STEPS.index(step) + 1} ")
            visit.wait_for_timeout(1000)
            assert findings(visit) == {}, step
        assert visit.title() == "evercal studio"


def test_the_viewer_is_accessible(browser: Any, hall_map: MapContents) -> None:
    page = Page(Localizer(hall_map), ViewOptions(port=0))
    try:
        with visited(browser, page.url) as (visit, _):
            seen_until(visit, "Click a keyframe")
            assert findings(visit) == {}
            assert visit.title() == "evercal view"
    finally:
        page.close()


def test_nothing_is_cut_off_on_a_phone(browser: Any, tmp_path: Path) -> None:
    with studio_of(tmp_path) as page, visited(browser, page.url, PHONE) as (visit, errors):
        seen_until(visit, "Images and gripper poses arrive.")
        click(visit, "Next: Record")
        click(visit, "Take sample")
        seen_until(visit, "Took sample 0000.jpg.")
        wide = "n => [...document.querySelectorAll(n)].filter(e => e.scrollWidth > e.clientWidth)"
        assert visit.evaluate(f"({wide})('.{OWN}').map(e => e.innerText)") == []
        inside = "n => [...document.querySelectorAll(n)].every(e => { const b = "
        inside += "e.getBoundingClientRect(); return b.left >= 0 && b.right <= innerWidth })"
        assert visit.evaluate(f"({inside})('.{OWN}, button')")
        assert errors == []


def test_the_keyboard_is_enough(browser: Any, tmp_path: Path) -> None:
    with studio_of(tmp_path) as page, visited(browser, page.url) as (visit, _):
        seen_until(visit, "Images and gripper poses arrive.")
        visit.keyboard.press("n")
        seen_until(visit, "2 Record")
        visit.keyboard.press("t")
        seen_until(visit, "Took sample 0000.jpg.")
        visit.keyboard.press("m")
        seen_until(visit, "The arm is there.")
        for _ in range(40):
            visit.keyboard.press("Tab")
            if visit.evaluate("document.activeElement.innerText") == "Take sample":
                break
        visit.keyboard.press("Enter")
        seen_until(visit, "Took sample 0001.jpg.")
        visit.keyboard.press("b")
        seen_until(visit, "1 Connect")
