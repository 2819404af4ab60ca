"""What a page may send to the studio, and folders that lie elsewhere."""

from __future__ import annotations

from typing import Any

import pytest

from evercal.errors import InputError

pytest.importorskip("viser")

from evercal.service.studio.page import StudioPage

from .test_studio import cell, studio_in

__all__ = ("cell",)


def test_values_outside_a_list_are_ignored(cell, tmp_path, caplog):
    """Whoever has the key can send any value."""
    page = StudioPage(studio_in(tmp_path, cell), "127.0.0.1", 0)
    try:
        page.studio.take_sample()
        controls = page.controls
        values: list[Any] = ["no camera", "", 7, None, ["fixed camera"]]
        for value in values:
            controls._camera.value = value
            page.studio.connection.look(controls.which)
            controls.show_live()
            assert controls.which == "wrist"
    finally:
        page.close()
    assert caplog.records == []
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "fixed").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="fixed: is a link; use a new folder"):
        studio_in(tmp_path / "linked", cell)
