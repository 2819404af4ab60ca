"""Makes the tables of the docs from `results/`.

A table stands in a page between two lines, and nobody writes there by hand:

    <!-- table: NAME KIND [ARGUMENT] -->
    <!-- end -->

NAME is a file of `results/`, or several joined by `+`; KIND is a key of `KINDS`.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.publish import FOLDER
from evercal.continual.benchmark.ablation import ablation_rows
from evercal.continual.benchmark.comparison import (
    Run,
    TableRows,
    by_strategy,
    difference_rows,
    method_rows,
    runs_of,
    scene_rows,
    selector_rows,
    threshold_rows,
)
from evercal.continual.benchmark.published import Published, Row, read_published
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6, COARSE, FINE, FINEST

DOCS = FOLDER.parent / "docs"
REGION = re.compile(
    r"^(<!-- table: (?P<names>\S+) (?P<kind>\S+)(?: (?P<argument>\S+))? -->\n)"
    r"(?P<body>.*?)^(<!-- end -->)$",
    re.MULTILINE | re.DOTALL,
)
ONE_RUN = "One run only, so no spread between seeds:"


def regenerated(text: str, folder: Path = FOLDER) -> str:
    """A page with its tables made anew.

    Raises:
        InputError: a table of unknown kind, one that is not ended, or results that are not there.
    """
    if text.count("<!-- table:") != len(REGION.findall(text)):
        raise InputError("a table is not written '<!-- table: NAME KIND -->' ... '<!-- end -->'")

    def made(match: re.Match[str]) -> str:
        if match["kind"] not in KINDS:
            raise InputError(f"table kind {match['kind']!r}: choose one of {', '.join(KINDS)}")
        sources = [read_published(folder / f"{n}.jsonl") for n in match["names"].split("+")]
        return f"{match[1]}{KINDS[match['kind']](sources, match['argument'] or '')}\n{match[6]}"

    return REGION.sub(made, text)


def pages(docs: Path = DOCS) -> list[Path]:
    """Pages that hold tables made from results."""
    return [page for page in sorted(docs.rglob("*.md")) if "<!-- table:" in page.read_text()]


def run(check: bool) -> int:
    """Rewrites the pages, or says which would change."""
    stale = []
    for page in pages():
        before = page.read_text()
        after = regenerated(before)
        if after != before:
            stale.append(page)
            if not check:
                page.write_text(after)
    for page in stale:
        print(f"{page.relative_to(DOCS.parent)}: {'out of date' if check else 'written'}")
    return 1 if check and stale else 0


def _runs(sources: Sequence[Published]) -> list[Run]:
    strategies = {k: v for source in sources for k, v in source.strategies.items()}
    return runs_of([found for source in sources for found in source.results()], strategies)


def _bench(rows_of: Callable[[Sequence[Run]], TableRows]) -> Callable[..., str]:
    """A table of strategies; those with one run stand apart where others have several.

    The argument `map` keeps those with a map, `network` those without one.
    """

    def made(sources: Sequence[Published], part: str) -> str:
        runs = _runs(sources)
        if part:
            wanted = {"map": True, "network": False}[part]
            runs = [run for run in runs if run.description["map"] == wanted]
        counts = {name: len(of) for name, of in by_strategy(runs).items()}
        several = [run for run in runs if counts[run.strategy] > 1]
        alone = [run for run in runs if counts[run.strategy] == 1]
        parts = [_markdown(rows_of(of)) for of in (several, alone) if of]
        return f"\n\n{ONE_RUN}\n\n".join(parts) if len(parts) > 1 else parts[0]

    return made


def _differences(sources: Sequence[Published], reference: str) -> str:
    """Those on one common seed stand apart."""
    runs = _runs(sources)
    seeds = {name: {run.seed for run in of} for name, of in by_strategy(runs).items()}
    if reference not in seeds:
        raise InputError(f"differences: no strategy {reference!r}; there are {', '.join(seeds)}")
    shared = {name: len(of & seeds[reference]) for name, of in seeds.items()}
    parts = []
    for wanted in (lambda n: n > 1, lambda n: n == 1):
        of = [run for run in runs if run.strategy == reference or wanted(shared[run.strategy])]
        rows = difference_rows(of, reference)
        parts += [_markdown(rows)] if len(rows) > 1 else []
    return f"\n\n{ONE_RUN}\n\n".join(parts)


def _ablation(sources: Sequence[Published], suite: str) -> str:
    """The paper's Table 4; its own numbers stand beside ours where the suite is one of its."""
    return _markdown(ablation_rows(_runs(sources), suite))


def _memory(sources: Sequence[Published], _: str) -> str:
    """What the same scenes come to with fewer keyframes."""
    shares = [_number(source.settings["memory_share"]) for source in sources]
    return _along(sources, "keyframes", [f"{100 * share:.0f} %" for share in shares])


def _steps(sources: Sequence[Published], _: str) -> str:
    """What the same scenes come to with more steps: a learning curve."""
    fits = [source.settings["fit"] for source in sources]
    steps = [_number(fit["iterations"]) for fit in fits if isinstance(fit, dict)]
    return _along(sources, "steps a scene", [f"{of:,.0f}" for of in steps])


def _number(value: object) -> float:
    assert isinstance(value, float | int), value
    return value


def _along(sources: Sequence[Published], title: str, told: Sequence[str]) -> str:
    """A row for each strategy and file, means over its runs."""
    bounds = {"5 cm/5 deg": COARSE, "1 cm/1 deg": FINE, "5 mm/0.5 deg": FINEST}
    rows = [[title, "strategy", *bounds, "median mm", "wrong scene", "MB"]]
    for source, label in zip(sources, told, strict=True):
        for name, of in by_strategy(runs_of(source.results())).items():
            last = [scene for run in of for scene in run.last]
            shares = [np.mean([r.scores(b).final_accuracy for r in of]) for b in bounds.values()]
            median = 1000 * np.median(np.concatenate([scene.translation_m for scene in last]))
            size = (last[0].memory_bytes + last[0].head_bytes) / 1e6
            wrong = sum(int(np.sum(scene.wrong_scene)) for scene in last) / len(of)
            more = [f"{median:.1f}" if np.isfinite(median) else "-", f"{wrong:.0f}", f"{size:.1f}"]
            rows.append([label, name, *(f"{share:.1f}" for share in shares), *more])
    return _markdown(rows)


BOUNDS = ("5 cm/5 deg", "2 cm/2 deg", "1 cm/1 deg", "0.5 cm/0.5 deg")


def _accuracy(sources: Sequence[Published], what: str) -> str:
    """A row for each group of rooms: shares of all frames, means of the rooms' medians."""
    titles = ["5 cm/5 deg", "2/2", "1/1", "5 mm/0.5 deg"]
    header = ["scenes (memory 10 %)", "frames", *titles, "median", "wrong scene", "refused"]
    table = [[*header, "in 95 % ellipsoid"]]
    for source in sources:
        rows = {str(row["scene"]): row for row in source.rows}
        for title, names in source.groups.items():
            of = [rows[name] for name in names]
            frames = _column(of, "frames")
            shares = [_share(np.average(_column(of, b), weights=frames)) for b in BOUNDS]
            counts = [f"{_column(of, key).sum():.0f}" for key in ("wrong_scene", "refused")]
            cells = [f"{frames.sum():.0f}", *shares, _median(of), *counts, _inside(of)]
            table.append([title, *cells])
    return _markdown(table)


def _spoiled(sources: Sequence[Published], what: str) -> str:
    """`maps mini`: what degraded images cost; each row of it is a mean over all rooms."""
    (source,) = sources
    names = [str(row["scene"]) for row in source.rows]
    rooms = names.index("mean")
    header = ["sim-mini, images spoiled", "1 cm/1 deg", "5 mm/0.5 deg", "median"]
    table = [[*header, "refused", "in 95 % ellipsoid"]]
    changed = [row for row in source.rows if str(row["scene"]).endswith("changed")]
    parts = [(str(row["scene"]), [row], rooms) for row in source.rows[rooms + 1 :]]
    parts = [part for part in parts if part[1][0] not in changed]
    for title, of, times in [*parts, ("after a change in the room", changed, 1)]:
        shares = [_share(_column(of, bound).mean()) for bound in BOUNDS[2:]]
        refused, frames = (times * _column(of, key).sum() for key in ("refused", "frames"))
        cells = [*shares, _median(of), f"{refused:.0f} of {frames:.0f}", _inside(of)]
        table.append([title, *cells])
    return _markdown(table)


def _fixed(sources: Sequence[Published], what: str) -> str:
    """`maps fixed`: cameras that stand still, before and after a bump."""
    (source,) = sources
    table = [["fixed camera, 25 images", *(str(row["scene"]) for row in source.rows)]]
    for title, prefix in (
        ("error", "error"),
        (
            f"bumped by {source.rows[0]['bump_mm']:.0f} mm: error of the measured shift",
            "bump_error",
        ),
    ):
        cells = [
            f"{row[f'{prefix}_mm']:.2f} mm, {row[f'{prefix}_deg']:.3f} deg" for row in source.rows
        ]
        table.append([title, *cells])
    return _markdown(table)


SPOILED_POSES = {
    "none": "as they are",
    "noise": "every pose by 2 mm and 0.2 deg",
    "offset": "all by one offset of 5.4 mm and 0.54 deg",
    "focal": "focal length 1 % too long",
    "gross": "every twentieth pose by 30 cm",
}


def _bad_poses(sources: Sequence[Published], what: str) -> str:
    """`maps badposes`: what training poses spoiled on purpose cost, and what was found."""
    (source,) = sources
    table = [["bedroom, training poses spoiled", "1 cm/1 deg", "median", "found"]]
    for kind, title in SPOILED_POSES.items():
        of = [row for row in source.rows if str(row["scene"]).split()[0] == kind]
        moved = f"{of[0]['common_error_mm']:.3f} mm, {of[0]['common_error_deg']:.3f} deg"
        found = {
            "none": f"nothing moved ({moved})",
            "noise": f"stated poses good to {_range(of, 'pose_sigma_mm', 1)} mm",
            "offset": f"the offset, to {moved}",
            "focal": f"{of[0]['focal_percent']:+.3f} % (true: -0.990 %)",
            "gross": f"{_column(of, 'named').sum():.0f} of {_column(of, 'planted').sum():.0f}"
            f" named, {_column(of, 'named_wrongly').sum():.0f} wrongly",
        }[kind]
        seeds = f" ({len(of)} seeds)" if len(of) > 1 else ""
        share = _share(_column(of, "1 cm/1 deg").mean())
        table.append([title + seeds, share, f"{_range(of, 'median_mm', 2)} mm", found])
    return _markdown(table)


def _trials(sources: Sequence[Published], what: str) -> str:
    """`calibration`: a row per kind of camera, its title the file's note; 25 images where told."""
    table = [["camera, from images alone", "trials", "median", "worst", "in 95 % ellipsoid"]]
    for source in sources:
        rows = [row for row in source.rows if row.get("images", 25) == 25]
        for prefix, title in (("", source.note), ("fixed_", "then a fixed camera in that map")):
            if f"{prefix}mm" not in rows[0]:
                continue
            mm, deg, squared = (
                _column(rows, f"{prefix}{name}") for name in ("mm", "deg", "squared_mahalanobis")
            )
            median, worst = (f"{at(mm):.2f} mm, {at(deg):.3f} deg" for at in (np.median, np.max))
            inside = f"{int((squared < CHI2_6).sum())} of {len(rows)}"
            table.append([title, str(len(rows)), median, worst, inside])
    return _markdown(table)


def _bump(sources: Sequence[Published], what: str) -> str:
    """`calibration bump`: how often the alarm calls a camera moved."""
    (source,) = sources
    moved: dict[str, list[bool]] = {}
    for row in source.rows:
        moved.setdefault(str(row["kind"]), []).append(bool(row["moved"]))
    trials = " and ".join(str(n) for n in sorted({len(of) for of in moved.values()}))
    title = f"bumped by (5 images, {trials} trials each)"
    cells = [f"{100 * np.mean(of):.1f} %" for of in moved.values()]
    return _markdown([[title, *moved], ["called moved", *cells]])


def _tuning(sources: Sequence[Published], what: str) -> str:
    """`tune`: a row for each method, its trials in order, the one that was taken in bold.

    A trial is told by its area under the curve for the earlier scenes + that for the newest.
    """
    suites = [str(source.settings["suite"]) for source in sources]
    table = [["method", "setting", "trials", *suites]]
    for method in dict.fromkeys(str(row["method"]) for row in sources[0].rows):
        of = [[row for row in source.rows if row["method"] == method] for source in sources]
        trials = ", ".join(f"{value:g}" for value in _column(of[0], "value"))
        cells = []
        for rows in of:
            parts = zip(_column(rows, "auc_earlier"), _column(rows, "auc_newest"), strict=True)
            told = [f"{earlier:.0f}+{newest:.0f}" for earlier, newest in parts]
            best = int(_column(rows, "auc_20cm").argmax())
            told[best] = f"**{told[best]}**"
            cells.append(", ".join(told))
        table.append([method, str(of[0][0]["setting"]), trials, *cells])
    return _markdown(table)


def _markdown(rows: TableRows) -> str:
    """A table without padding: a cell that changes changes one line."""
    header, *body = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _column(rows: Sequence[Row], key: str) -> np.ndarray:
    return np.array([np.nan if row[key] is None else row[key] for row in rows], dtype=float)


def _inside(rows: Sequence[Row]) -> str:
    """Per cent of all poses in the right scene that lie in their ellipsoid; "-" without any."""
    poses = _column(rows, "frames") - _column(rows, "wrong_scene") - _column(rows, "refused")
    if not (some := poses > 0).any():
        return "-"
    return f"{np.average(_column(rows, 'inside_95')[some], weights=poses[some]):.0f} %"


def _share(percent: float) -> str:
    return "100" if percent > 99.95 else f"{percent:.1f}"


def _median(rows: Sequence[Row]) -> str:
    mm, deg = (_column(rows, key).mean() for key in ("median_mm", "median_deg"))
    return f"{mm:.{2 if mm < 10 else 1}f} mm, {deg:.3f} deg"


def _range(rows: Sequence[Row], key: str, digits: int) -> str:
    values = _column(rows, key)
    ends = [f"{end:.{digits}f}" for end in (values.min(), values.max())]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


KINDS: dict[str, Callable[[Sequence[Published], str], str]] = {
    "methods": _bench(method_rows),
    "thresholds": _bench(threshold_rows),
    "scenes": _bench(scene_rows),
    "selectors": _bench(selector_rows),
    "differences": _differences,
    "ablation": _ablation,
    "memory": _memory,
    "steps": _steps,
    "accuracy": _accuracy,
    "spoiled": _spoiled,
    "fixed": _fixed,
    "badposes": _bad_poses,
    "trials": _trials,
    "bump": _bump,
    "tuning": _tuning,
}
"""What a table may be; a bench's tables come first."""
