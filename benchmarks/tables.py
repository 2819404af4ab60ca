"""Generates the tables of the docs from `results/`.

A table lies between two marks, and is not edited by hand:

    <!-- table: NAME KIND [ARGUMENT] -->
    <!-- end -->

NAME is a file of `results/`, or several joined by `+`. KIND is a key of `KINDS`.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from evercal.continual.benchmark.ablation import ablation_rows
from evercal.continual.benchmark.published import Published, read_published

from benchmarks.publish import FOLDER
from evercal.continual.benchmark.comparison import (
    AREA,
    Run,
    TableRows,
    by_strategy,
    contrast_rows,
    difference_rows,
    method_rows,
    number,
    runs_of,
    scene_rows,
    selector_rows,
    threshold_rows,
)
from evercal.errors import InputError
from evercal.evaluation.metrics import CHI2_6, COARSE, FINE, FINEST

DOCS = FOLDER.parent / "docs"
REGION = re.compile(
    r"^(<!-- table: (?P<names>\S+) (?P<kind>\S+)(?: (?P<argument>\S+))? -->\n)"
    r"(?P<body>.*?)^(<!-- end -->)$",
    re.MULTILINE | re.DOTALL,
)
ONE_RUN = "One run only, so no spread between seeds:"
BOUNDS = ("5 cm/5 deg", "2 cm/2 deg", "1 cm/1 deg", "0.5 cm/0.5 deg")


def run(check: bool = False) -> int:
    """Generate the tables of the docs from results/.

    Args:
        check: Write nothing; exit 1 if a page does not agree with its data.
    """
    outdated = []
    for page in pages():
        before = page.read_text()
        after = regenerated(before)
        if after != before:
            outdated.append(page)
            if not check:
                page.write_text(after)
    for page in outdated:
        print(f"{page.relative_to(DOCS.parent)}: {'out of date' if check else 'written'}")
    return 1 if check and outdated else 0


def regenerated(text: str, folder: Path = FOLDER) -> str:
    """Return a page with its tables generated again.

    Raises:
        InputError: An unknown kind of table, a missing end mark, or missing results.
    """
    if text.count("<!-- table:") != len(REGION.findall(text)):
        raise InputError("a table lacks '<!-- table: NAME KIND -->' or '<!-- end -->'")

    def generated(match: re.Match[str]) -> str:
        if match["kind"] not in KINDS:
            raise InputError(f"table kind {match['kind']!r}: choose one of {', '.join(KINDS)}")
        sources = [read_published(folder / f"{n}.jsonl") for n in match["names"].split("+")]
        return f"{match[1]}{KINDS[match['kind']](sources, match['argument'] or '')}\n{match[6]}"

    return REGION.sub(generated, text)


def pages() -> list[Path]:
    """Return the pages with generated tables."""
    return [page for page in sorted(DOCS.rglob("*.md")) if "<!-- table:" in page.read_text()]


def markdown(rows: TableRows) -> str:
    """Format a table without padding, so that a changed cell changes one line."""
    header, *body = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def published_runs(sources: Sequence[Published]) -> list[Run]:
    """Return the complete runs of several files, with the description of each strategy."""
    strategies = {k: v for source in sources for k, v in source.strategies.items()}
    return runs_of([result for source in sources for result in source.results()], strategies)


def _bold(row: Sequence[str]) -> list[str]:
    """Emphasize the row that matters."""
    return [f"**{cell}**" for cell in row]


def _bench(rows_of: Callable[[Sequence[Run]], TableRows]) -> Callable[..., str]:
    """Return a table of strategies; strategies with one run form a second table."""

    def generated(sources: Sequence[Published], _: str) -> str:
        groups = by_strategy(published_runs(sources)).values()
        several = [run for group in groups if len(group) > 1 for run in group]
        single = [run for group in groups if len(group) == 1 for run in group]
        parts = [markdown(rows_of(runs)) for runs in (several, single) if runs]
        return f"\n\n{ONE_RUN}\n\n".join(parts) if len(parts) > 1 else parts[0]

    return generated


SUMMARY = (
    *("strategy", "runs", "final %", "1 cm 1 deg %", AREA, "last scene %", "TFR"),
    *("memory MB", "s"),
)
"""Columns of the kind `summary`."""


def _summary_rows(runs: Sequence[Run]) -> TableRows:
    """Tabulate the main columns of `method_rows`, without parts of strategies (`NAME:PART`).

    Seconds are means over the runs of one machine, the one with most runs.
    """
    runs = [run for run in runs if ":" not in run.strategy]
    rows = method_rows(runs)
    places = Counter(run.last[0].environment for run in runs)
    common = places.most_common(1)[0][0]
    timed = method_rows([run for run in runs if run.last[0].environment == common])
    seconds = {row[0]: row[timed[0].index("s")] for row in timed}
    return [
        [seconds.get(row[0], "-") if name == "s" else row[rows[0].index(name)] for name in SUMMARY]
        for row in rows
    ]


def _differences(sources: Sequence[Published], reference: str) -> str:
    """Tabulate differences; strategies with one common seed form a second table."""
    runs = published_runs(sources)
    seeds = {name: {run.seed for run in group} for name, group in by_strategy(runs).items()}
    if reference not in seeds:
        raise InputError(f"differences: no strategy {reference!r}; there are {', '.join(seeds)}")
    single = {name for name in seeds if len(seeds[name] & seeds[reference]) == 1}
    parts = []
    for names in (seeds.keys() - single, single):
        group = [run for run in runs if run.strategy in names | {reference}]
        rows = difference_rows(group, reference)
        parts += [markdown(rows)] if len(rows) > 1 else []
    return f"\n\n{ONE_RUN}\n\n".join(parts)


def _contrasts(sources: Sequence[Published], pairs: str) -> str:
    """Tabulate the contrasts `A-B,C-D`, corrected for their number."""
    split = [pair.partition("-") for pair in pairs.split(",")]
    named = [(ours, theirs) for ours, _, theirs in split]
    return markdown(contrast_rows(published_runs(sources), named))


def _environments(sources: Sequence[Published], _: str) -> str:
    """Tabulate where the runs were measured: a row per commit and machine."""
    names = ["commit", "processor", "gpu", "precision", "torch", "threads"]
    table = [[*names, "runs"]]
    for source in sources:
        for key, record in source.environments.items():
            runs = {(s.strategy, s.seed) for s in source.scenes if s.environment == key}
            table.append([*(record[name] for name in names), str(len(runs))])
    return markdown(table)


def _ablation(sources: Sequence[Published], suite: str) -> str:
    """Tabulate the paper's Table 4, with its numbers if the suite is one of its own."""
    return markdown(ablation_rows(published_runs(sources), suite))


def _memory(sources: Sequence[Published], names: str) -> str:
    """Tabulate the same scenes with several shares of keyframes, means over runs.

    The argument is a list of strategies; without it all are tabulated.
    """
    wanted = names.split(",") if names else []
    bounds = {"5 cm/5 deg": COARSE, "1 cm/1 deg": FINE, "5 mm/0.5 deg": FINEST}
    rows = [["keyframes", "strategy", *bounds, "median mm", "wrong scene", "MB"]]
    for source in sources:
        memory = source.settings["memory"]
        assert isinstance(memory, dict), "settings of `evercal bench`"
        label = f"{100 * memory['share']:.0f} %"
        for name, runs in by_strategy(published_runs([source])).items():
            if wanted and name not in wanted:
                continue
            ends = [result for run in runs for result in run.last]
            shares = [np.mean([r.scores(b).final_accuracy for r in runs]) for b in bounds.values()]
            median = 1000 * float(np.median(np.concatenate([run.errors_m() for run in runs])))
            wrong = sum(int(np.sum(end.wrong_scene)) for end in ends) / len(runs)
            size = (ends[0].memory_bytes + ends[0].head_bytes) / 1e6
            cells = [f"{share:.1f}" for share in shares]
            cells += [number(median if np.isfinite(median) else np.nan), f"{wrong:.0f}"]
            rows.append([label, name, *cells, f"{size:.1f}"])
    return markdown(rows)


def _accuracy(sources: Sequence[Published], _: str) -> str:
    """Tabulate groups of rooms: shares of all frames, means of the rooms' medians."""
    titles = ["5 cm/5 deg", "2/2", "1/1", "5 mm/0.5 deg"]
    header = ["scenes (memory 10 %)", *titles, "median", "refused, wrong scene"]
    table = [[*header, "in 95 % ellipsoid"]]
    for source in sources:
        rows = _frame(source).set_index("scene")
        for title, names in source.groups.items():
            group = rows.loc[list(names)]
            frames = group["frames"]
            shares = [_share(np.average(group[bound], weights=frames)) for bound in BOUNDS]
            refused, wrong = (group[key].sum() for key in ("refused", "wrong_scene"))
            counts = f"{refused:.0f}, {wrong:.0f} of {frames.sum():.0f}"
            table.append([title, *shares, _median(group), counts, _inside(group)])
    return markdown([table[0], _bold(table[1]), *table[2:]])


def _degraded(sources: Sequence[Published], _: str) -> str:
    """Tabulate `maps mini`: degraded images, each row of the file a mean over all rooms."""
    rows = _frame(sources[0])
    rooms = rows["scene"].tolist().index("mean")
    is_changed = rows["scene"].str.endswith("changed")
    groups = [
        (str(row["scene"]), rows.iloc[[i]], rooms)
        for i, row in rows.iterrows()
        if int(str(i)) > rooms and not is_changed.iloc[int(str(i))]
    ]
    header = ["sim-mini, degraded images", "1 cm/1 deg", "5 mm/0.5 deg", "median"]
    table = [[*header, "refused", "in 95 % ellipsoid"]]
    for title, group, times in [*groups, ("after a change in the room", rows[is_changed], 1)]:
        shares = [_share(group[bound].mean()) for bound in BOUNDS[2:]]
        refused, frames = (times * group[key].sum() for key in ("refused", "frames"))
        cells = [*shares, _median(group), f"{refused:.0f} of {frames:.0f}", _inside(group)]
        table.append([title, *cells])
    return markdown(table)


def _fixed(sources: Sequence[Published], _: str) -> str:
    """Tabulate `maps fixed`: fixed cameras, before and after a bump."""
    rows = sources[0].rows
    table = [["fixed camera, 25 images", *(str(row["scene"]) for row in rows)]]
    bump = f"bumped by {rows[0]['bump_mm']:.0f} mm: error of the measured shift"
    for title, prefix in (("error", "error"), (bump, "bump_error")):
        cells = [f"{row[f'{prefix}_mm']:.2f} mm, {row[f'{prefix}_deg']:.3f} deg" for row in rows]
        table.append([title, *cells])
    return markdown([table[0], _bold(table[1]), *table[2:]])


POSE_ERRORS = {
    "none": "correct poses",
    "noise": "noise of 2 mm and 0.2 deg",
    "offset": "common offset of 5.4 mm and 0.54 deg",
    "focal": "focal length 1 % too long",
    "gross": "every twentieth pose off by 30 cm",
}


def _bad_poses(sources: Sequence[Published], _: str) -> str:
    """Tabulate `maps badposes`: the cost of wrong training poses, and what was estimated."""
    rows = _frame(sources[0])
    groups = _groups(rows.assign(kind=rows["scene"].str.split().str[0]), "kind")
    table = [["bedroom, wrong training poses", "1 cm/1 deg", "median", "estimate"]]
    for kind, title in POSE_ERRORS.items():
        group = groups[kind]
        first = group.iloc[0]
        common = f"{first['common_error_mm']:.3f} mm, {first['common_error_deg']:.3f} deg"
        estimated = {
            "none": f"common offset of {common}",
            "noise": f"noise of {_range(group, 'pose_sigma_mm', 1)} mm",
            "offset": f"offset, with an error of {common}",
            "focal": f"{first['focal_percent']:+.3f} % (true: -0.990 %)",
            "gross": f"{group['named'].sum():.0f} of {group['planted'].sum():.0f} reported,"
            f" {group['named_wrongly'].sum():.0f} false reports",
        }[kind]
        seeds = f" ({len(group)} seeds)" if len(group) > 1 else ""
        share = _share(_column(group, "1 cm/1 deg").mean())
        table.append([title + seeds, share, f"{_range(group, 'median_mm', 2)} mm", estimated])
    return markdown(table)


def _trials(sources: Sequence[Published], _: str) -> str:
    """Tabulate `calibration`: a row per kind of camera with 25 images, titled by the note."""
    table = [["camera, from images alone", "trials", "median", "worst", "in 95 % ellipsoid"]]
    for source in sources:
        rows = _frame(source)
        if "images" in rows:
            rows = rows.query("images == 25")
        for prefix, title in (("", source.note), ("fixed_", "then a fixed camera in that map")):
            if f"{prefix}mm" not in rows:
                continue
            mm, deg, squared = (
                _column(rows, f"{prefix}{name}") for name in ("mm", "deg", "squared_mahalanobis")
            )
            median, worst = (f"{at(mm):.2f} mm, {at(deg):.3f} deg" for at in (np.median, np.max))
            inside = f"{int((squared < CHI2_6).sum())} of {len(rows)}"
            table.append([title, str(len(rows)), median, worst, inside])
    return markdown(table)


def _bump(sources: Sequence[Published], _: str) -> str:
    """Tabulate `calibration bump`: how often a camera is reported as moved."""
    groups = _groups(_frame(sources[0]), "kind")
    trials = " and ".join(str(count) for count in sorted({len(of) for of in groups.values()}))
    title = f"bumped by (5 images, {trials} trials each)"
    shares = {kind: f"{100 * _column(of, 'moved').mean():.1f} %" for kind, of in groups.items()}
    return markdown([[title, *shares], ["reported as moved", *shares.values()]])


def _rows(sources: Sequence[Published], columns: str) -> str:
    """Tabulate rows as they are; the argument lists their columns, separated by commas."""
    frame = pd.concat([_frame(source) for source in sources])
    names = [name for name in columns.split(",") if name] or list(frame.columns)
    cells = frame[names].map(lambda v: f"{v:.3g}" if isinstance(v, float) else str(v))
    table = [[name.replace("_", " ") for name in names], *cells.replace("nan", "").to_numpy()]
    return markdown([[str(cell) for cell in row] for row in table])


def _tuning(sources: Sequence[Published], _: str) -> str:
    """Tabulate `tune`: the trials of each method, the selected one in bold.

    A trial is its area under the recall curve for the earlier scenes + that for the newest.
    """
    table = [["method", "setting", "trials", *(str(s.settings["suite"]) for s in sources)]]
    grouped = [_groups(_frame(source), "method") for source in sources]
    for method, rows in grouped[0].items():
        cells = []
        for groups in grouped:
            trials = groups[method]
            parts = zip(_column(trials, "auc_earlier"), _column(trials, "auc_newest"), strict=True)
            cell = [f"{earlier:.0f}+{newest:.0f}" for earlier, newest in parts]
            best = int(_column(trials, "auc_20cm").argmax())
            cell[best] = f"**{cell[best]}**"
            cells.append(", ".join(cell))
        values = ", ".join(f"{value:g}" for value in rows["value"])
        table.append([method, str(rows["setting"].iloc[0]), values, *cells])
    return markdown(table)


def _frame(source: Published) -> pd.DataFrame:
    return pd.DataFrame(list(source.rows))


def _groups(rows: pd.DataFrame, key: str) -> dict[str, pd.DataFrame]:
    return {str(value): group for value, group in rows.groupby(key, sort=False)}


def _column(rows: pd.DataFrame, key: str) -> np.ndarray:
    return rows[key].to_numpy(float)


def _inside(rows: pd.DataFrame) -> str:
    """Return the per cent of poses in the right scene that lie in their ellipsoid."""
    poses = _column(rows, "frames") - _column(rows, "wrong_scene") - _column(rows, "refused")
    if not (poses > 0).any():
        return "-"
    inside = _column(rows, "inside_95")[poses > 0]
    return f"{np.average(inside, weights=poses[poses > 0]):.0f} %"


def _share(percent: float) -> str:
    return "100" if percent > 99.95 else f"{percent:.1f}"


def _median(rows: pd.DataFrame) -> str:
    mm, deg = (_column(rows, key).mean() for key in ("median_mm", "median_deg"))
    return f"{mm:.{2 if mm < 10 else 1}f} mm, {deg:.3f} deg"


def _range(rows: pd.DataFrame, key: str, digits: int) -> str:
    values = _column(rows, key)
    ends = [f"{end:.{digits}f}" for end in (values.min(), values.max())]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


KINDS: dict[str, Callable[[Sequence[Published], str], str]] = {
    "methods": _bench(method_rows),
    "summary": _bench(_summary_rows),
    "thresholds": _bench(threshold_rows),
    "scenes": _bench(scene_rows),
    "selectors": _bench(selector_rows),
    "differences": _differences,
    "contrasts": _contrasts,
    "environments": _environments,
    "ablation": _ablation,
    "memory": _memory,
    "accuracy": _accuracy,
    "degraded": _degraded,
    "fixed": _fixed,
    "badposes": _bad_poses,
    "trials": _trials,
    "bump": _bump,
    "rows": _rows,
    "tuning": _tuning,
}
"""Kinds of tables; those of `evercal bench` come first."""
