"""What a published table rests on: one small file of numbers, from which the table is made again.

    results/NAME.jsonl    first line: name, kind, note, settings and their hash
                          then a line per strategy, seed, stage and scene (kind `bench`), values
                          in the order of `fields` of the first line,
                          or any flat rows of a measurement (kind `rows`)

Of the last stage, which methods are compared by, errors are kept frame by frame, cut to 0.1 mm and
0.001 deg; the bounds of accuracy are multiples of these, so every frame stays right or wrong. Of
earlier stages counts are kept.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Literal

import numpy as np

from evercal.continual.benchmark import results
from evercal.continual.benchmark.results import SceneResult
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6, COARSE, FINE, FINEST, MIDDLE
from evercal.storage import read_settings, write_bytes

LOOSE = (0.10, math.radians(10.0))
"""10 cm and 10 deg, in metres and radians."""
COUNTED = (LOOSE, COARSE, MIDDLE, FINE, FINEST)
"""Metres and radians under which correct frames are counted."""
LARGEST_BYTES = 500_000
"""No file is larger."""
Row = Mapping[str, str | float | int | bool | None]
"""A flat row of a measurement."""


@dataclass(frozen=True)
class PublishedScene:
    """How one scene's test frames fared after one stage of one run, in few numbers."""

    strategy: str
    """Which strategy."""
    seed: int
    """Of the run."""
    stage: int
    """Scenes learned so far, less one."""
    scene: str
    """Whose test frames these are."""
    frames: int
    """How many."""
    within: tuple[int, ...]
    """Frames right under each of `COUNTED`."""
    median_mm: float
    """Median error of all frames, infinite where most have no pose in the right scene."""
    median_deg: float
    """The same of the rotation."""
    wrong_scene: int
    """Frames that got a pose in another scene."""
    refused: int
    """Frames without a pose."""
    stated_95: int
    """Frames with a pose in the right scene and an ellipsoid."""
    inside_95: int
    """Those whose true pose lies in it."""
    seconds: float
    """Wall time of the stage."""
    memory_bytes: int
    """What is remembered of all scenes."""
    head_bytes: int
    """All heads as stored."""
    frames_kept: int
    """Remembered frames of the stage's scene."""
    covering_radius: float = math.nan
    """See `SceneResult`."""
    min_spacing: float = math.nan
    """See `SceneResult`."""
    tenth_mm: tuple[int | None, ...] = ()
    """Of the last stage: error of each frame in tenths of a millimetre, rounded down."""
    mdeg: tuple[int | None, ...] = ()
    """Of the last stage: error of each frame in thousandths of a degree, rounded down."""
    state: str = ""
    """Of the last stage, a letter a frame: `w` wrong scene, `r` refused, `i` inside the ellipsoid,
    `o` outside, `p` a pose without one."""

    @property
    def keyframe_positions_m(self) -> tuple[tuple[float, float, float], ...]:
        """Not published."""
        return ()

    def accuracy(self, thresholds: tuple[float, float] = COARSE) -> float:
        """Share of correct frames under one of `COUNTED`, 0 to 1.

        Raises:
            KeyError: other thresholds.
        """
        for bound, count in zip(COUNTED, self.within, strict=True):
            if np.allclose(bound, thresholds, rtol=1e-9):
                return count / self.frames
        raise KeyError(f"frames within {thresholds} were not counted")


@dataclass(frozen=True)
class Published:
    """A file of results."""

    name: str
    """That of the file."""
    kind: Literal["bench", "rows"]
    """What its lines are."""
    settings: Mapping[str, object]
    """What decided the results; empty where nobody wrote it down."""
    note: str = ""
    """What a reader must know besides."""
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Rows that a table takes together, by its title for them; of kind `rows`."""
    frames: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of each scene's test frames in recorded order; of kind `bench`."""
    strategies: Mapping[str, Mapping[str, object]] = field(default_factory=dict)
    """What each strategy is (`Strategy.description`), by name; of kind `bench`."""
    scenes: tuple[PublishedScene, ...] = ()
    """Lines of kind `bench`."""
    rows: tuple[Row, ...] = ()
    """Lines of kind `rows`."""

    @property
    def settings_sha256(self) -> str:
        """Of the settings as sorted JSON."""
        text = json.dumps(self.settings, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def results(self) -> list[SceneResult | PublishedScene]:
        """What `comparison.runs_of` takes: the last stage frame by frame, the others counted."""
        return [self._whole(of) if of.state else of for of in self.scenes]

    def _whole(self, of: PublishedScene) -> SceneResult:
        def middle(values: Sequence[int | None], unit: float) -> tuple[float, ...]:
            return tuple(math.inf if v is None else (v + 0.5) * unit for v in values)

        inside = {"i": 0.0, "o": math.inf}
        return SceneResult(
            strategy=of.strategy,
            seed=of.seed,
            stage=of.stage,
            scene=of.scene,
            frames=self.frames[of.scene],
            translation_m=middle(of.tenth_mm, 1e-4),
            rotation_rad=middle(of.mdeg, math.radians(1e-3)),
            wrong_scene=tuple(letter == "w" for letter in of.state),
            near_training_frame=(False,) * of.frames,  # nothing that is published needs it
            seconds=of.seconds,
            memory_bytes=of.memory_bytes,
            head_bytes=of.head_bytes,
            frames_kept=of.frames_kept,
            covering_radius=of.covering_radius,
            min_spacing=of.min_spacing,
            squared_mahalanobis=tuple(inside.get(letter, math.nan) for letter in of.state),
        )


def from_bench(folder: Path, name: str, note: str = "") -> Published:
    """What is published of a benchmark's folder: the runs whose last stage is done.

    Raises:
        InputError: no run is done, or one line is broken.
    """
    found = results.read(folder)
    last = max((of.stage for of in found), default=-1)
    ended = {(of.strategy, of.seed) for of in found if of.stage == last}
    if not ended:
        raise InputError(f"{folder}: no run is done; go on with 'evercal bench'")
    frames = {of.scene: of.frames for of in found if of.stage == last}
    kept = [of for of in found if (of.strategy, of.seed) in ended]
    other = next((of for of in kept if of.frames != frames[of.scene]), None)
    if other is not None:
        raise InputError(f"{folder}: runs judge {other.scene} by different frames")
    scenes = tuple(_counted(of, of.stage == last) for of in kept)
    settings = read_settings(folder / results.SETTINGS)
    ran = {of.strategy.partition(":")[0] for of in kept}
    strategies = {k: v for k, v in results.read_strategies(folder).items() if k in ran}
    return Published(
        name, "bench", settings, note, frames=frames, strategies=strategies, scenes=scenes
    )


def write_published(folder: Path, published: Published) -> Path:
    """Writes `FOLDER/NAME.jsonl`.

    Raises:
        InputError: it would be larger than `LARGEST_BYTES`.
    """
    header = {
        "name": published.name,
        "kind": published.kind,
        "note": published.note,
        "settings_sha256": published.settings_sha256,
        "settings": published.settings,
    }
    for key in ("groups", "frames", "strategies"):
        if getattr(published, key):
            header[key] = getattr(published, key)
    if published.kind == "bench":
        header["fields"] = _FIELDS
    lines = [header, *map(_plain, published.scenes), *map(dict, published.rows)]
    text = "".join(json.dumps(o, allow_nan=False, separators=(",", ":")) + "\n" for o in lines)
    if len(text) > LARGEST_BYTES:
        raise InputError(
            f"{published.name}: {len(text) / 1e3:.0f} kB, more than {LARGEST_BYTES / 1e3:.0f};"
            f" publish fewer strategies, or two tables"
        )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{published.name}.jsonl"
    write_bytes(path, text.encode())
    return path


def read_published(path: Path) -> Published:
    """Reads what `write_published` wrote.

    Raises:
        InputError: no such file, a line that is none of ours, or settings that were changed.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        raise InputError(f"{path}: no such results; make them with 'benchmarks publish'") from None
    number = 1
    try:
        header = json.loads(lines[0])
        stated = header.pop("settings_sha256")
        if header.pop("fields", _FIELDS) != _FIELDS:
            raise ValueError("other fields")
        for key in ("groups", "frames"):
            header[key] = {k: tuple(v) for k, v in header.get(key, {}).items()}
        found: list[PublishedScene] = []
        rows: list[Row] = []
        for number, line in enumerate(lines[1:], start=2):  # noqa: B007  # for the message
            record = json.loads(line)
            if header["kind"] == "bench":
                found.append(_scene(record))
            else:
                rows.append(dict(record))
        published = Published(**header, scenes=tuple(found), rows=tuple(rows))
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise InputError(f"{path}: line {number} is not a published result ({error!r})") from error
    if published.settings_sha256 != stated:
        raise InputError(f"{path}: the settings are not those that the results were made with")
    return published


def _counted(of: SceneResult, frame_by_frame: bool) -> PublishedScene:
    squared = np.array(of.squared_mahalanobis or (math.nan,) * len(of.frames))
    metres, radians = np.array(of.translation_m), np.array(of.rotation_rad)
    told: dict[str, object] = {}
    if frame_by_frame:
        told["tenth_mm"] = _floored(metres * 1e4)
        told["mdeg"] = _floored(np.rad2deg(radians) * 1e3)
        state = np.where(np.isnan(squared), "p", np.where(squared < CHI2_6, "i", "o"))
        state[of.refused], state[np.array(of.wrong_scene, bool)] = "r", "w"
        told["state"] = "".join(state)
    return PublishedScene(
        strategy=of.strategy,
        seed=of.seed,
        stage=of.stage,
        scene=of.scene,
        frames=len(of.frames),
        within=tuple(int(of.correct(bound).sum()) for bound in COUNTED),
        median_mm=round(1000 * sorted(of.translation_m)[len(metres) // 2], 3),
        median_deg=round(math.degrees(sorted(of.rotation_rad)[len(metres) // 2]), 4),
        wrong_scene=sum(of.wrong_scene),
        refused=int(of.refused.sum()),
        stated_95=int((~np.isnan(squared)).sum()),
        inside_95=int((squared < CHI2_6).sum()),
        seconds=round(of.seconds, 1),
        memory_bytes=of.memory_bytes,
        head_bytes=of.head_bytes,
        frames_kept=of.frames_kept,
        covering_radius=_rounded(of.covering_radius, 4),
        min_spacing=_rounded(of.min_spacing, 4),
        **told,  # pyright: ignore[reportArgumentType]
    )


def _floored(values: np.ndarray) -> tuple[int | None, ...]:
    return tuple(math.floor(v) if math.isfinite(v) else None for v in values.tolist())


def _rounded(value: float, digits: int) -> float:
    return math.nan if math.isnan(value) else round(value, digits)


_FIELDS = [of.name for of in fields(PublishedScene)]
_INFINITE = ("median_mm", "median_deg")


def _plain(scene: PublishedScene) -> list[object]:
    """Values in the order of the fields, those at the end that are not known left out."""
    values = list(asdict(scene).values())
    while values[-1] in ((), "") or values[-1] is math.nan:
        values.pop()
    return [
        None if isinstance(value, float) and not math.isfinite(value) else value for value in values
    ]


def _scene(values: list[object]) -> PublishedScene:
    if not isinstance(values, list) or len(values) > len(_FIELDS):
        raise ValueError("other fields")
    record = dict(zip(_FIELDS, values, strict=False))
    for key, value in record.items():
        if isinstance(value, list):
            record[key] = tuple(value)
        elif value is None:
            record[key] = math.inf if key in _INFINITE else math.nan
    return PublishedScene(**record)  # pyright: ignore[reportArgumentType]
