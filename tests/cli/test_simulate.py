"""`evercal simulate`: bad input, and a small cell from end to end."""

import json
import shutil
from pathlib import Path

from evercal.recordings import load_recording


def test_a_cell_has_the_stated_parts(run, tmp_path):
    out = tmp_path / "cell"
    words = ("--frames 3 --size 64x64 --seed 4 --noise 0",)
    assert (
        f"wrote {out}: 3 wrist, 8 tripod" in run("simulate cell --out", out, *words).out
    )
    shutil.rmtree(out)
    report = run.json("simulate cell --out", out, *words)
    assert (report["scenes"], report["frames"]) == ([str(out / "wrist")], 3 + 8 + 25)
    frames = load_recording(out / "wrist").train
    assert [frame.read_image().shape for frame in frames] == 3 * [(64, 64, 3)]
    assert len(list(Path(report["tripod"]).iterdir())) == 8
    truth = json.loads(Path(report["truth.json"]).read_text())
    assert (truth["seed"], truth["options"]["image_noise"]) == (4, 0)
