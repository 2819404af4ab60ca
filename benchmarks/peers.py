"""evercal beside public peers on the same frames: SIFT and XFeat with triangulation and PnP.

Each scene is learned alone. A peer is measured twice: with all training frames kept, and with the
same share of them as evercal remembers, chosen by SARS with the radius that fills the memory and
triangulated among all training frames, as a map would be, after which only the kept ones stay.
Every method is examined by `evercal.evaluation.evaluate`: one test image at a time, decoding
included in the time; a frame without a pose has infinite errors and counts as wrong.
Bytes are what a method keeps of the scene to answer from: descriptors and points of a peer,
remembered frames and network head of evercal. What does not depend on the scene, as the encoder
and XFeat's network, is counted for none.
"""

import json
import math
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from tqdm import tqdm

from benchmarks.peer_features import DETECTORS, Detector, FeatureOptions
from benchmarks.peer_map import PeerLocalizer, Place, QueryOptions, build, describe
from benchmarks.peer_triangulation import TriangulationOptions
from evercal.continual.learn_scene import LearnOptions, learn_scene
from evercal.continual.presets import preset
from evercal.errors import InputError
from evercal.evaluation import evaluate
from evercal.evaluation.metrics import FrameResult, correct
from evercal.evaluation.protocol import SceneLocalizer
from evercal.evaluation.tables import table
from evercal.localization.localizer import Localizer
from evercal.mapping.selection import SarsOptions, select_sars
from evercal.recordings import (
    MIN_TRAIN_FRAMES,
    Recording,
    load_recording,
    posed_frames,
    posed_recording,
    stated_poses,
)

Method = Literal["evercal", "sift", "xfeat"]
BOUNDS: dict[str, tuple[float, float]] = {
    "5cm 5deg %": (0.05, math.radians(5.0)),
    "2cm 2deg %": (0.02, math.radians(2.0)),
    "1cm 1deg %": (0.01, math.radians(1.0)),
    "5mm 0.5deg %": (0.005, math.radians(0.5)),
}
"""Metres and radians below which a frame is right."""


@dataclass(frozen=True)
class PeerOptions:
    """Settings of a comparison; they go into its JSON file."""

    share: float = 0.10
    """Share of the training frames that evercal and the small peers keep."""
    features: FeatureOptions = field(default_factory=FeatureOptions)
    """Of the peers' images."""
    triangulation: TriangulationOptions = field(default_factory=TriangulationOptions)
    """Of the peers' points."""
    query: QueryOptions = field(default_factory=QueryOptions)
    """Of the peers' answers."""
    preset: str = "fast"
    """How much work evercal puts into a scene."""


@dataclass(frozen=True, eq=False)
class Entry:
    """A method that has learned a scene and can be asked."""

    name: str
    """Its row."""
    localizer: SceneLocalizer
    """Answers."""
    build_seconds: float
    """Wall time from encoded images to the first answer."""
    bytes: int
    """What it keeps of the scene."""
    frames_kept: int
    """Training frames of which it keeps something."""


@dataclass(frozen=True)
class Row:
    """One method on one scene."""

    method: str
    """Name and share of the frames kept."""
    frames: int
    """Test frames."""
    accuracy: dict[str, float]
    """Per cent, by the names of BOUNDS."""
    median_translation_cm: float
    """Over all frames, those without a pose as infinite."""
    median_rotation_deg: float
    """The same."""
    without_pose: int
    """Test frames that got none."""
    ms_per_image: float
    """Median milliseconds of one image at a time, decoding included."""
    build_seconds: float
    """Wall time from encoded images to the first answer."""
    bytes: int
    """What it keeps of the scene."""
    frames_kept: int
    """Training frames of which it keeps something."""


def run(
    paths: Sequence[Path],
    methods: Sequence[Method],
    limit: int | None,
    out: Path | None,
    options: PeerOptions,
) -> None:
    """Compares on every scene and prints a table for each; writes the numbers to `out`."""
    _check(paths, limit, options)
    detectors = _detectors(methods, options)
    record: dict[str, object] = {"options": asdict(options), "limit": limit}
    found: dict[str, list[dict[str, object]]] = {}
    for scene in [_load(path, limit) for path in paths]:
        rows: list[Row] = []
        for row in compare(scene, "evercal" in methods, detectors, options):
            rows.append(row)
            found[scene.name] = [_plain(row) for row in rows]
            if out is not None:  # after every row: the next one may take an hour
                out.parent.mkdir(parents=True, exist_ok=True)
                out.write_text(json.dumps(record | {"scenes": found}, indent=2) + "\n")
        print(f"\n{scene.name}: {len(scene.train)} training, {len(scene.test)} test frames\n")
        print(row_table(rows))


def compare(
    scene: Recording, with_evercal: bool, detectors: dict[str, Detector], options: PeerOptions
) -> Iterator[Row]:
    """One row per method, as soon as it is measured.

    Args:
        scene: training frames all posed.
        with_evercal: whether evercal is measured, too.
        detectors: the peers, by name.
        options: all settings.

    Raises:
        InputError: as `learn_scene` and `evaluate`.
    """
    if with_evercal:
        with tempfile.TemporaryDirectory() as folder:
            yield _examined(evercal_entry(scene, Path(folder) / "store", options), scene)
    for name, detector in detectors.items():
        for entry in peer_entries(scene, name, detector, options):
            yield _examined(entry, scene)


def evercal_entry(scene: Recording, store: Path, options: PeerOptions) -> Entry:
    """Learns the scene into a new store, opens it and answers once: the one place to adapt."""
    print(f"{scene.name}: evercal learns", file=sys.stderr)
    began = time.perf_counter()
    stage = replace(preset(options.preset), memory_share=options.share)
    report = learn_scene(store, scene, LearnOptions(stage=stage))
    localizer = Localizer.open(store)
    # The first answer waits until the remembered frames are encoded.
    localizer.localize(scene.train[0].read_image(), scene.train[0].camera)
    seconds = time.perf_counter() - began
    kept = report.memory_bytes + report.head_bytes
    return Entry(_titled("evercal", options), localizer, seconds, kept, report.frames_kept)


def peer_entries(
    scene: Recording, name: str, detector: Detector, options: PeerOptions
) -> Iterator[Entry]:
    """The peer with all training frames, then with a share of them chosen by SARS."""

    def bar(title: str, what: Iterable) -> Iterable:
        return tqdm(what, f"{scene.name}: {name} {title}", leave=False, mininterval=0.5)

    place, side = Place(), options.features.short_side
    retrieved = options.query.retrieved
    described = describe(scene.train, detector, side, place, bar)
    every = np.arange(len(scene.train))
    poses = stated_poses(scene.train)
    few = select_sars(
        poses.translation_m,
        poses.rotation_wxyz,
        max(1, int(options.share * len(every) + 1e-9)),  # rounded as evercal does
        SarsOptions(fill=True),
    )
    for title, kept in ((f"{name} all", every), (_titled(name, options), few)):
        built = build(described, kept, options.triangulation, retrieved, bar)
        localizer = PeerLocalizer(scene, built, detector, side, place, options.query)
        yield Entry(title, localizer, built.seconds, built.bytes, len(kept))


def row_table(rows: Sequence[Row]) -> str:
    """The rows as text for the terminal."""
    header = [
        "method",
        *BOUNDS,
        "median cm",
        "median deg",
        "no pose",
        "ms",
        "build s",
        "MB",
        "frames kept",
    ]
    cells = [
        [
            row.method,
            *[f"{share:.1f}" for share in row.accuracy.values()],
            f"{row.median_translation_cm:.2f}",
            f"{row.median_rotation_deg:.3f}",
            str(row.without_pose),
            f"{row.ms_per_image:.0f}",
            f"{row.build_seconds:.0f}",
            f"{row.bytes / 1e6:.2f}",
            str(row.frames_kept),
        ]
        for row in rows
    ]
    return table(header, cells, "terminal")


def _examined(entry: Entry, scene: Recording) -> Row:
    title, total = f"{scene.name}: {entry.name}", len(posed_frames(scene.test))
    with tqdm(total=total, desc=title, leave=False, mininterval=0.5) as bar:

        def advance(done: int, total: int) -> None:
            bar.update()

        results = evaluate(entry.localizer, {scene.name: scene}, on_frame=advance)
    return _scored(entry, results)


def _scored(entry: Entry, results: list[FrameResult]) -> Row:
    metres = np.array([result.translation_error_m for result in results])
    radians = np.array([result.rotation_error_rad for result in results])
    middle = len(results) // 2  # not np.median: between a number and infinity there is none
    return Row(
        method=entry.name,
        frames=len(results),
        accuracy={
            name: 100.0 * float(np.mean(next(iter(correct(results, bound).values()))))
            for name, bound in BOUNDS.items()
        },
        median_translation_cm=100.0 * float(np.sort(metres)[middle]),
        median_rotation_deg=math.degrees(np.sort(radians)[middle]),
        without_pose=int(np.isinf(metres).sum()),
        ms_per_image=float(np.median([result.milliseconds for result in results])),
        build_seconds=entry.build_seconds,
        bytes=entry.bytes,
        frames_kept=entry.frames_kept,
    )


def _titled(name: str, options: PeerOptions) -> str:
    return f"{name} {100 * options.share:g} %"


def _check(paths: Sequence[Path], limit: int | None, options: PeerOptions) -> None:
    if not paths:
        raise InputError("peers: no scene; give the folders of one or more recorded scenes")
    if limit is not None and limit < 1:
        raise InputError(f"--limit {limit}: give a number of test frames >= 1")
    if not 0 < options.share <= 1:
        raise InputError(f"share {options.share}: give a share of the frames between 0 and 1")


def _detectors(methods: Sequence[Method], options: PeerOptions) -> dict[str, Detector]:
    """The peers asked for; one that is not installed is left out where others are measured."""
    found: dict[str, Detector] = {}
    for name in dict.fromkeys(method for method in methods if method in DETECTORS):
        try:
            found[name] = DETECTORS[name](options.features)
        except InputError as error:
            if len(methods) == 1:
                raise
            print(f"left out: {error}", file=sys.stderr)
    return found


def _load(path: Path, limit: int | None) -> Recording:
    """A scene with posed frames only and at most `limit` test frames, evenly spread."""
    scene = posed_recording(load_recording(path))
    if len(scene.train) < MIN_TRAIN_FRAMES:
        raise InputError(
            f"{path}: {len(scene.train)} posed training frames are too few; "
            f"give at least {MIN_TRAIN_FRAMES}"
        )
    test = posed_frames(scene.test)
    if not test:
        raise InputError(f"{path}: no test frame with a known pose; give a scene that has some")
    if limit is not None and limit < len(test):
        some = np.linspace(0, len(test) - 1, limit).round().astype(int)
        test = tuple(test[i] for i in some)
    return replace(scene, test=test)


def _plain(row: Row) -> dict[str, object]:
    """For JSON; None stands for infinite."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in asdict(row).items()
    }
