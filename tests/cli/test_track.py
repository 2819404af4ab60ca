"""`evercal track` on the command line."""

import time
from collections import Counter
from collections.abc import Iterator

from evercal.cli.track import Track
from evercal.live import camera
from evercal.recordings import streams


def test_a_folder_is_tracked_into_files(run, store, rooms, tmp_path):
    images = rooms[0] / "images"
    tum = tmp_path / "t.tum"
    lines = tmp_path / "t.jsonl"
    ran = run("track", store, images, "--out", tum, lines, "--most", 6, "--json")
    report = ran.json
    assert report["frames"] == 6
    assert report["tracking"] + report["relocalized"] + report["lost"] == 6
    assert ran.code == (0 if report["tracking"] + report["relocalized"] else 1)
    assert len(lines.read_text().splitlines()) == 6
    located = report["tracking"] + report["relocalized"]
    assert len(tum.read_text().splitlines()) == 1 + located


def test_a_live_camera_is_tracked_in_its_newest_frames(
    run,
    hall_store,
    hall,
    tmp_path,
    monkeypatch,
):
    image = hall.test[3].read_image()

    def frames(source: str, rate: float) -> Iterator[streams.StreamFrame]:
        for i in range(30):
            time.sleep(0.005)
            yield streams.StreamFrame(str(i), time.time(), image, time.monotonic())

    for module in (streams, camera):
        monkeypatch.setattr(module, "stream", frames)
    ran = run("track", hall_store, "0 --out", tmp_path / "t.jsonl", "--json")
    assert 1 <= ran.json["frames"] < 30
    assert ran.code == 0


def test_motion_that_is_too_fast_is_warned_of(tmp_path, capsys):
    verb = Track(tmp_path, "images")
    verb._summary(Counter(tracking=6, relocalized=6), [20.0] * 12)
    out = capsys.readouterr().out
    assert "warning: 6 of 12 frames are located from nothing: the view changes" in out
    verb._summary(Counter(tracking=11, relocalized=1), [20.0] * 12)
    verb._summary(Counter(lost=12), [20.0] * 12)
    assert "warning" not in capsys.readouterr().out
