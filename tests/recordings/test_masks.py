"""Masks beside images."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import load_recording, write_image
from evercal.recordings.samples import FOLDER


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return Path(
        shutil.copytree(FOLDER.parent / "sample_cell/wrist", tmp_path / "wrist")
    )


@pytest.mark.parametrize("ending", [".png", ".jpg.png"])
def test_what_is_black_has_one_colour_and_the_rest_stays(
    recording: Path, ending: str
) -> None:
    before = load_recording(recording).train[0]
    old = before.read_image()
    mask = np.full(old.shape, 255, np.uint8)
    mask[60:180, 100:220] = 0
    name = Path(str(before.image)).stem
    (recording / "masks").mkdir()
    write_image(recording / "masks" / f"{name}{ending}", mask)
    loaded = load_recording(recording)
    new = loaded.train[0].read_image()
    assert "Masks of 1 of" in loaded.notes[-1]
    inner = new[80:160, 120:200].reshape(-1, 3)
    assert np.ptp(inner, axis=0).max() <= 1
    np.testing.assert_allclose(inner.mean(0), old[mask[..., 0] > 0].mean(0), atol=8)
    np.testing.assert_array_equal(new[:40], old[:40])
    np.testing.assert_array_equal(
        loaded.train[1].read_image(), load_recording(recording).train[1].read_image()
    )


def test_masks_of_another_size_or_name_are_refused(recording: Path) -> None:
    (recording / "masks").mkdir()
    write_image(recording / "masks" / "other.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="no mask has the name of an image"):
        load_recording(recording)
    name = Path(
        str(load_recording(FOLDER.parent / "sample_cell/wrist").train[0].image)
    ).stem
    write_image(recording / "masks" / f"{name}.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="mask is 4x4, its image"):
        load_recording(recording).train[0].read_image()
