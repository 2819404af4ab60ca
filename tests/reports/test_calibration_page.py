"""The page says what the calibration says, names what is missing, and shows text as text."""

from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from evercal.calibration.calibration import Calibration, ErrorTerm, ImageUse
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.reports import calibration_page as calibration_page_module
from evercal.reports import encode_image
from evercal.reports.calibration_comparison import Older, difference
from evercal.reports.calibration_page import Page, Subject, calibration_page
from evercal.reports.calibration_views import View, Views
from evercal.reports.frame_axes import axes_in_view


def placed(quaternion: ArrayLike, translation: ArrayLike) -> SE3:
    return SE3(np.array(quaternion, np.float64), np.array(translation, np.float64))


NASTY = "<script>alert(\"1\")</script> & '$x^{$'"
LENS = Camera(160, 120, 150.0, 150.0, 79.5, 59.5, (0.1, 0.0, 0.0, 0.0))
POSE = placed([0.0, 1.0, 0.0, 0.0], [0.1, 0.05, 1.0])
GREY = np.full((120, 160, 3), 90, np.uint8)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grey picture in place of each chart: what they show is tested on its own."""
    for name in ("ellipsoid_shadows", "error_terms", "residual_bars"):
        monkeypatch.setattr(calibration_page_module, name, lambda *_: encode_image(GREY))


class Reader(HTMLParser):
    """Collects text by tag, rows of tables and pictures; fails on a tag closed out of turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.said: list[tuple[str, str]] = []
        self.rows: list[list[str]] = []
        self.pictures: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "img":
            self.pictures.append(dict(attrs)["src"] or "")
        elif tag != "meta":
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.said.append((self.open[-1], data))
            if self.open[-1] in ("td", "th"):
                self.rows[-1][-1] += data

    def text(self, tag: str) -> str:
        return "\n".join(data for where, data in self.said if where == tag)

    def row(self, first: str) -> list[str]:
        return next(row for row in self.rows if row[0] == first)


def full(**more: Any) -> Calibration:
    found = Calibration(
        "eye_to_hand",
        POSE,
        np.diag([1e-8, 4e-8, 9e-8, 1e-10, 1e-10, 4e-10]),
        "panda_link0",
        "camera_optical",
        LENS,
        (
            ImageUse("shots/a.png", True, "", 0.51, 0.012),
            ImageUse("shots/b.png", False, "lies 20.8 mm and 1.14 deg from the other images", 20.8),
            ImageUse("shots/c.png", False, "failed: too dark"),
        ),
        (ErrorTerm("landmarks and lens", 0.2, 0.001), ErrorTerm("scatter", 0.05, 0.0002)),
        {"repeatability_mm": 0.31, "repeatability_deg": 0.013, "held_out_mm": 2.25, "spots": 3},
        "Good enough for bin picking.",
        {"command": "calibrate", "scene": "cell", "map": "abc", "store": "cell.evercal"},
        "2026-01-02T03:04:05+00:00",
    )
    return replace(found, **more)


def solved() -> Calibration:
    """As a command without images and intrinsics writes it."""
    return Calibration(
        "eye_in_hand", POSE, 1e-6 * np.eye(6), "gripper", source={"command": "solve"}
    )


def read(subject: Subject) -> tuple[Reader, Page]:
    page = calibration_page(subject)
    return Reader(page.html), page


@pytest.mark.usefixtures("quick")
def test_every_image_and_reason_appears() -> None:
    found = full()
    reader, _ = read(Subject("c.json", found))
    rows = {row[1]: row for row in reader.rows if len(row) == 6}
    for image, name in zip(found.images, ("a.png", "b.png", "c.png"), strict=True):
        assert rows[name][2] == ("yes" if image.used else "no")
        assert rows[name][3] == image.reason
    assert rows["a.png"][4:] == ["0.51", "0.012"]
    assert rows["b.png"][4:] == ["20.80", "-"]
    assert rows["c.png"][4:] == ["-", "-"]
    assert "1 of 3 used; all of them in shots/" in reader.text("caption")


@pytest.mark.usefixtures("quick")
def test_the_verdict_comes_first_with_its_tiers() -> None:
    reader, _ = read(Subject("c.json", full()))
    assert reader.said[3] == ("p", "Good enough for bin picking.")  # after the titles and style
    reached = {row[0]: row[3] for row in reader.rows[1:5]}
    # The held-out error, 2.25 mm, is what decides.
    assert reached == {
        "precision assembly": "not good enough",
        "bin picking": "good enough",
        "tabletop tasks": "good enough",
        "unusable": "no",
    }
    bad, _ = read(Subject("c.json", full(checks={"held_out_mm": 50.0}, verdict="")))
    assert bad.row("unusable")[3] == "yes: do not use it"
    assert bad.row("tabletop tasks")[3] == "not good enough"
    assert "Unusable: even tabletop tasks ask" in bad.text("p")


@pytest.mark.usefixtures("quick")
def test_the_transform_reads_back() -> None:
    reader, _ = read(Subject("c.json", full()))
    assert "pose of camera_optical in panda_link0" in reader.text("p")
    assert "takes points from camera_optical to panda_link0" in reader.text("p")
    assert reader.row("quaternion")[1:] == [f"{v:.8f}" for v in (1, 0, 0, 0)]  # x y z w
    assert reader.row("translation, mm")[1:4] == ["100.000", "50.000", "1000.000"]
    rows = [reader.row(f"{axis} of panda_link0")[1:] for axis in "xyz"]
    assert np.array(rows, float) == pytest.approx(POSE.matrix()[:3])
    sigma = reader.row("position along the axes of panda_link0, mm")[1:]
    assert sigma == ["0.100", "0.200", "0.300", "0.216"]


def test_checks_ellipsoid_and_source_are_there() -> None:
    reader, page = read(Subject("c.json", full()))
    assert reader.row("two halves of the data, apart")[1:] == ["0.31", "0.013"]
    assert reader.row("data that was held out, from the answer")[1:] == ["2.25", "-"]
    assert reader.row("spots")[1:] == ["3"]
    # sqrt of 7.815, the 95 % point of chi squared, times the standard deviations.
    assert "half axes are 0.84, 0.56 and 0.28 mm" in reader.text("p")
    assert "along (0.00, 0.00, 1.00) of panda_link0, 0 deg from" in reader.text("p")
    assert "landmarks and lens; scatter" in reader.text("figcaption")
    for what, value in (
        ("command", "calibrate"),
        ("store", "cell.evercal"),
        ("scene", "cell"),
        ("made at", "2026-01-02T03:04:05+00:00"),
        ("image size", "160x120 pixels"),
        ("focal lengths fx, fy", "150.000, 150.000 pixels"),
        ("distortion k1 k2 p1 p2 k3 ...", "0.1, 0, 0, 0"),
    ):
        assert reader.row(what)[1] == value
    assert page.missing == ()
    assert len(reader.pictures) == 3
    assert all(src.startswith("data:image/") for src in reader.pictures)


@pytest.mark.usefixtures("quick")
def test_what_is_missing_is_said_and_not_made_up() -> None:
    nothing = Views(missing=("No pictures: the calibration holds no intrinsics.",))
    reader, page = read(Subject("s.json", solved(), nothing))
    told = reader.text("p")
    for what in ("pictures", "list of images", "parts of the error", "repeatability", "intrinsics"):
        assert f"No {what}" in told, what
    assert "No held-out error" in told
    assert {sentence.split(":")[0] for sentence in page.missing} == {
        "No pictures",
        "No list of images",
        "No parts of the error",
        "No repeatability",
        "No held-out error",
        "No intrinsics",
    }
    assert len(reader.pictures) == 1  # the ellipsoid
    assert "Good for bin picking (within 3 mm" in told  # made from its numbers
    without = replace(solved(), covariance=np.zeros((6, 6)), source={})
    reader, page = read(Subject("s.json", without, nothing))
    assert reader.pictures == []
    assert "Trust no verdict" in reader.text("p")
    assert any("No source" in sentence for sentence in page.missing)


def test_strings_are_text() -> None:
    images = (ImageUse(NASTY, False, NASTY, 1.0, 1.0),)
    nasty = full(
        parent_frame=NASTY,
        child_frame="c" + NASTY,
        images=images,
        error_terms=(ErrorTerm(NASTY, 1.0, 1.0),),
        checks={NASTY: NASTY},
        verdict=NASTY,
        source={NASTY: NASTY, "deep": {"a": [NASTY]}},
        created=NASTY,
    )
    lens = nasty.camera
    assert lens is not None
    views = Views((View(NASTY, GREY, NASTY, 0, None, NASTY),), axes_in_view(lens, POSE.inverse()))
    reader, _ = read(Subject(NASTY, nasty, views, NASTY, Older(NASTY, nasty)))
    assert not reader.tags & {"script", "a", "link", "iframe", "object"}
    assert reader.said[3] == ("p", NASTY)
    # A slash ends a folder's name: what stands before it is in the caption.
    assert any(NASTY.split("/")[-1] in row[1] and row[3] == NASTY for row in reader.rows[5:])
    assert [NASTY, NASTY] in reader.rows


@pytest.mark.usefixtures("quick")
def test_pictures_say_where_the_base_is_and_how_far_landmarks_lie() -> None:
    found = full()
    axes = axes_in_view(LENS, POSE.inverse())
    views = Views((View("shots/a.png", GREY, "used", 12, 0.345), View("b.png", GREY, "used", 3, 1)))
    seen = replace(views, axes=axes, close_up=GREY)
    reader, page = read(Subject("c.json", found, seen, "cell.evercal"))
    x, y = axes.origin_px
    assert f"puts the origin of panda_link0 at pixel ({x:.1f}, {y:.1f})" in reader.text("p")
    assert reader.row("a.png") == ["a.png", "12", "0.34"] or reader.row("a.png")[2] == "0.35"
    assert "landmarks of cell.evercal" in reader.text("p")
    assert len(reader.pictures) == 5
    assert page.missing == ()
    unseen = replace(views, axes=axes_in_view(LENS, placed([1.0, 0, 0, 0], [0, 0, -0.2])))
    reader, _ = read(Subject("c.json", found, replace(unseen, other_map=True), "cell.evercal"))
    assert "panda_link0 lies behind the camera, 200 mm" in reader.text("p")
    assert "is not the one that the calibration was made with" in reader.text("p")
    plain = replace(seen, views=(View("a.png", GREY, "used"),), close_up=None)
    _, page = read(Subject("c.json", found, plain))
    assert page.missing == ("No landmarks: give the store with --store to see them.",)


@pytest.mark.usefixtures("quick")
def test_the_difference_to_an_older_one_is_in_words() -> None:
    found = full()
    older = replace(found, parent_from_child=SE3.exp([0, 0.003, 0.004, 0, 0, 0]) @ POSE)
    turned = replace(found, parent_from_child=POSE @ SE3.exp([0, 0, 0, np.deg2rad(2), 0, 0]))
    assert difference(found, older) == pytest.approx((5.0, 0.0), abs=1e-9)
    assert difference(found, turned) == pytest.approx((0.0, 2.0), abs=1e-9)
    reader, _ = read(Subject("c.json", found, older=Older("old.json", older)))
    assert "Compared with old.json" in reader.text("h2")
    said = reader.text("p")
    assert "lies 5.00 mm and 0.000 deg from where old.json has it" in said
    assert "-3.00 and -4.00 mm along x, y and z of panda_link0" in said
    assert "Both come from one map" in said
    renamed = replace(older, parent_frame="base", source={})
    reader, _ = read(Subject("c.json", found, older=Older("old.json", renamed)))
    assert "calls its parent frame base" in reader.text("p")
    assert "do not come from one map" in reader.text("p")
    with pytest.raises(InputError, match="it is eye_in_hand and the calibration is eye_to_hand"):
        difference(found, replace(found, mount="eye_in_hand"))


@pytest.mark.parametrize("value", ["much", True, float("nan"), [1.0]])
def test_a_check_that_is_no_number_is_named(value: object) -> None:
    with pytest.raises(InputError, match=r"checks\.held_out_mm"):
        calibration_page(Subject("c.json", full(checks={"held_out_mm": value})))
