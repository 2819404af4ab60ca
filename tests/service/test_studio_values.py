"""What a page may send to the studio, and folders that lie elsewhere."""

from __future__ import annotations

from typing import Any

import pytest

from evercal.errors import InputError

pytest.importorskip("viser")

import viser

from evercal.service.studio.page import StudioPage
from evercal.service.viewer.gate import chosen

from .test_studio import cell, studio_in

__all__ = ("cell",)


def inputs(page: StudioPage) -> list[Any]:
    return list(page.server.gui._gui_input_handle_from_uuid.values())


def test_a_step_has_one_button_that_leads_on(cell, tmp_path):
    """`Stop` can be pressed while something runs only."""
    page = StudioPage(studio_in(tmp_path, cell), "127.0.0.1", 0)
    try:
        tabs: dict[str, list[Any]] = {}
        for one in inputs(page):
            if isinstance(one, viser.GuiButtonHandle):
                tabs.setdefault(one._impl.parent_container_id, []).append(one)
        stops = [b for tab in tabs.values() for b in tab if b.label == "Stop"]
        assert all(stop.disabled for stop in stops)
        leads = {
            tuple(b.label for b in tab if b.color is None and b not in stops)
            for tab in tabs.values()
        }
        assert leads == {
            ("Record by itself",),
            ("Learn the recording",),
            ("Take 8 images",),
            ("Export file",),
            (),  # the folders that remove samples
        }
        page.tasks._running.acquire()
        page.refresh()
        assert not any(stop.disabled for stop in stops)
    finally:
        page.tasks._running.release()
        page.close()


def test_tabs_show_the_camera_that_they_record(cell, tmp_path):
    page = StudioPage(studio_in(tmp_path, cell), "127.0.0.1", 0)
    try:
        page.studio.connection.look("fixed")
        page.controls.show_live()
        shown = [(which, p.visible) for which, p in page.controls._pictures]
    finally:
        page.close()
    wrist = ("wrist", False)
    fixed = ("fixed", True)
    assert shown == [wrist, fixed, wrist, fixed, fixed]


def test_values_outside_a_list_are_ignored(cell, tmp_path, caplog):
    """Whoever has the key can send any value."""
    page = StudioPage(studio_in(tmp_path, cell), "127.0.0.1", 0)
    try:
        page.studio.take_sample()
        values: list[Any] = ["no camera", "", 7, None, ["fixed camera"]]
        (dropdown,) = (
            c for c in inputs(page) if "fixed camera" in getattr(c, "options", ())
        )
        for value in values:
            dropdown.value = value
            assert chosen(dropdown) == "camera on the gripper"
    finally:
        page.close()
    assert caplog.records == []
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "fixed").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="fixed: is a link; use a new folder"):
        studio_in(tmp_path / "linked", cell)
