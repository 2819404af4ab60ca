"""The tables of docs/ and research/ from results/, as Markdown.

results/NAME.csv, NAME.json    rows of one measurement, its settings and a note
results/networks-*/            folders of `evercal bench`
"""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from benchmarks import network_tables
from benchmarks.network_tables import FOLDER
from evercal.continual.benchmark.results import Table
from evercal.continual.strategies import strategy_named
from evercal.evaluation.metrics import CHI2_6

FIGURE = FOLDER.parent / "docs" / "networks.svg"
BOUNDS = ("5 cm/5 deg", "2 cm/2 deg", "1 cm/1 deg", "0.5 cm/0.5 deg")


def run(figure: bool = False) -> None:
    """Print every table of docs/ and research/ whose numbers are in results/.

    Args:
        figure: Also draw docs/networks.svg.
    """
    for name, table in TABLES.items():
        print(f"{name}\n\n{markdown(table())}\n")
    if figure:
        network_tables.draw("networks-a", FIGURE)


def markdown(table: Table) -> str:
    """Format a table as the pages have it: without padding, numbers to the right."""
    text = table.to_markdown(index=False, disable_numparse=True, tablefmt="pipe")
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
    ]
    lines[1] = ["---", *["---:"] * (len(lines[0]) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def rows_of(name: str) -> Table:
    """Read the rows of a measurement."""
    return pd.read_csv(FOLDER / f"{name}.csv", keep_default_na=False, na_values=[""])


def _rows(columns: str, name: str) -> Callable[[], Table]:

    def table() -> Table:
        rows = rows_of(name)[columns.split(",")]
        cells = rows.map(lambda v: f"{v:.3g}" if isinstance(v, float) else str(v))
        return cells.replace("nan", "").rename(
            columns=lambda name: name.replace("_", " ")
        )

    return table


def _accuracy(
    title: str, groups: Sequence[tuple[str, str, str]]
) -> Callable[[], Table]:
    """Return a table of rooms: shares of all frames, means of the rooms' medians.

    Args:
        title: Title of the first column.
        groups: Title, file of rows, and its rooms separated by commas.
    """

    def table() -> Table:
        return pd.DataFrame([_accuracy_row(title, *group) for group in groups])

    return table


def _accuracy_row(head: str, title: str, name: str, rooms: str) -> dict[str, str]:
    group = rows_of(name).set_index("scene").loc[rooms.split(",")]
    frames = group["frames"]
    heads = ("5 cm/5 deg", "2/2", "1/1", "5 mm/0.5 deg")
    shares = [_share(np.average(group[bound], weights=frames)) for bound in BOUNDS]
    refused, wrong = (group[key].sum() for key in ("refused", "wrong_scene"))
    return {
        head: title,
        **dict(zip(heads, shares, strict=True)),
        "median": _median(group),
        "refused, wrong scene": f"{refused:.0f}, {wrong:.0f} of {frames.sum():.0f}",
        "in 95 % ellipsoid": _inside(group),
    }


def _degraded() -> Table:
    """Degraded images; each such row of the file is a mean over the three rooms."""
    rows = rows_of("mini").iloc[4:]
    changed = rows["scene"].str.endswith("changed")
    groups = [
        (row.scene, rows.loc[[row.Index]], 3) for row in rows[~changed].itertuples()
    ]
    table = []
    for title, group, rooms in [
        *groups,
        ("after a change in the room", rows[changed], 1),
    ]:
        refused, frames = (rooms * group[key].sum() for key in ("refused", "frames"))
        cells = {"sim-mini, degraded images": title}
        cells["1 cm/1 deg"] = _share(group["1 cm/1 deg"].mean())
        cells["5 mm/0.5 deg"] = _share(group["0.5 cm/0.5 deg"].mean())
        cells["median"] = _median(group)
        cells["refused"] = f"{refused:.0f} of {frames:.0f}"
        cells["in 95 % ellipsoid"] = _inside(group)
        table.append(cells)
    return pd.DataFrame(table)


def _fixed() -> Table:
    rows = rows_of("fixed").set_index("scene")
    bump = f"bumped by {rows['bump_mm'].iloc[0]:.0f} mm: error of the measured shift"
    cells = {
        title: rows[f"{key}_mm"].map("{:.2f} mm, ".format)
        + rows[f"{key}_deg"].map("{:.3f} deg".format)
        for title, key in (("error", "error"), (bump, "bump_error"))
    }
    return pd.DataFrame(cells).T.reset_index(names="fixed camera, 25 images")


def _bad_poses() -> Table:
    """The cost of wrong training poses, and what was estimated."""
    rows = rows_of("badposes")
    table = []
    for kind, group in rows.groupby(rows["scene"].str.split().str[0], sort=False):
        first = group.iloc[0]
        common = (
            f"{first['common_error_mm']:.3f} mm, {first['common_error_deg']:.3f} deg"
        )
        reported = (
            f"{group['named'].sum():.0f} of {group['planted'].sum():.0f} reported"
        )
        title, estimate = {
            "none": ("correct poses", f"common offset of {common}"),
            "noise": (
                "noise of 2 mm and 0.2 deg",
                f"noise of {_range(group['pose_sigma_mm'], 1)} mm",
            ),
            "offset": (
                "common offset of 5.4 mm and 0.54 deg",
                f"offset, with an error of {common}",
            ),
            "focal": (
                "focal length 1 % too long",
                f"{first['focal_percent']:+.3f} % (true: -0.990 %)",
            ),
            "gross": (
                "every twentieth pose off by 30 cm",
                f"{reported}, {group['named_wrongly'].sum():.0f} false reports",
            ),
        }[kind]
        seeds = f" ({len(group)} seeds)" if len(group) > 1 else ""
        cells = {"bedroom, wrong training poses": title + seeds}
        cells["1 cm/1 deg"] = _share(group["1 cm/1 deg"].mean())
        cells["median"] = f"{_range(group['median_mm'], 2)} mm"
        table.append(cells | {"estimate": estimate})
    return pd.DataFrame(table)


def _trials() -> Table:
    """`calibration wrist` and `fixed`: cameras from images alone."""
    wrist = rows_of("wrist")
    fixed = rows_of("fixed-sim7").query("images == 25")
    mount = "`gripper_from_camera`, without an initial value, packaged rooms, gripper poses to"
    table = []
    for title, rows, prefix in (
        (f"{mount} 0.2 mm and 0.02 deg", wrist, ""),
        ("then `base_from_camera` of a fixed camera in that map", wrist, "fixed_"),
        ("fixed, 25 images, sim-7, version 0.1.0", fixed, ""),
    ):
        mm = rows[f"{prefix}mm"]
        deg = rows[f"{prefix}deg"]
        inside = (rows[f"{prefix}squared_mahalanobis"] < CHI2_6).sum()
        cells = {"camera, from images alone": title, "trials": len(rows)}
        cells["median"] = f"{mm.median():.2f} mm, {deg.median():.3f} deg"
        cells["worst"] = f"{mm.max():.2f} mm, {deg.max():.3f} deg"
        table.append(cells | {"in 95 % ellipsoid": f"{inside} of {len(rows)}"})
    return pd.DataFrame(table)


def _bump() -> Table:
    groups = rows_of("bump").groupby("kind", sort=False)["moved"]
    title = f"bumped by (5 images, {groups.size().iloc[0]} trials each)"
    shares = (100 * groups.mean()).map("{:.1f} %".format)
    return pd.DataFrame([{title: "reported as moved", **shares}])


def _tuning(name: str, suite: str) -> Callable[[], Table]:
    """Return the trials of each method, the selected one in bold.

    A trial is its area under the recall curve for the earlier scenes + that for the newest.
    """

    def table() -> Table:
        lines = []
        for method, trials in rows_of(name).groupby("method", sort=False):
            tuned = strategy_named(str(method)).method
            assert tuned, "only a method has a weight"
            columns = [trials[key] for key in ("auc_earlier", "auc_newest")]
            cells = [f"{old:.0f}+{new:.0f}" for old, new in zip(*columns, strict=True)]
            best = int(trials["auc_20cm"].to_numpy().argmax())
            cells[best] = f"**{cells[best]}**"
            values = ", ".join(f"{value:g}" for value in trials["value"])
            line = {
                "method": method,
                "setting": tuned.weight_field,
                "trials": values,
            }
            lines.append(line | {suite: ", ".join(cells)})
        return pd.DataFrame(lines)

    return table


def _inside(rows: Table) -> str:
    poses = rows["frames"] - rows["wrong_scene"] - rows["refused"]
    return f"{np.average(rows['inside_95'], weights=poses):.0f} %"


def _share(percent: float) -> str:
    return "100" if percent > 99.95 else f"{percent:.1f}"


def _median(rows: Table) -> str:
    mm, deg = (rows[key].mean() for key in ("median_mm", "median_deg"))
    return f"{mm:.{2 if mm < 10 else 1}f} mm, {deg:.3f} deg"


def _range(values: Table, digits: int) -> str:
    ends = [f"{end:.{digits}f}" for end in (values.min(), values.max())]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


_ROOMS = "scenes (memory 10 %)"


def _guard() -> Table:
    """Numbers of an older build and of this one, for each recording."""
    builds = [of for _, of in rows_of("guard").groupby("build", sort=False)]
    old, now = builds[:2]
    table = now[["recording", "n"]].astype(str)
    for key in ("2_cm", "1_cm", "refused", "inside_position", "inside_pose", "wrong"):
        before = old[key].map("{:.3g} → ".format).to_numpy()
        table[key.replace("_", " ")] = before + now[key].map("{:.3g}".format)
    return table


def _mutants() -> Table:
    """Mutants of each file, and those that the tests noticed before and now."""
    rows = rows_of("mutants")
    rows["file"] = rows["file"].str.removeprefix("src/evercal/")
    real = rows[rows["outcome"] != "equivalent"]
    groups = ["seed", "file"]
    table = pd.DataFrame({"drawn": rows.groupby(groups, sort=False).size()})
    table["not equivalent"] = real.groupby(groups).size()
    for title, key in (("killed before", "before"), ("killed", "outcome")):
        table[title] = (real[key] == "killed").groupby([real[k] for k in groups]).sum()
    return table.reset_index().astype(str)


TABLES: dict[str, Callable[[], Table]] = {
    "results: rooms and real recordings": _accuracy(
        _ROOMS,
        [
            ("sim-mini, all three rooms learned", "mini", "bedroom,kitchen,living"),
            ("redkitchen", "real", "redkitchen"),
            ("fr1_rpy", "real", "fr1_rpy"),
        ],
    ),
    "results: degraded images": _degraded,
    "results: wrong training poses": _bad_poses,
    "results: fixed cameras": _fixed,
    "map: PnP": _rows("matches,outliers,solver,right_%,median_mm,ms", "pnp"),
    "speed: both versions": _rows("what,beside,now,ratio", "speed"),
    "speed: AVX2": _rows("what,beside,now,ratio", "speed-avx2"),
    "boards: solvers": lambda: _rows(
        "condition,median_mm,p95_mm,inside_95,size_flagged,ms,Park_mm,Daniilidis_mm,"
        "reprojection_mm",
        "handeye-boards",
    )().query("not condition.str.startswith('two sessions')"),
    "boards: sessions": lambda: _rows(
        "condition,trials,median_mm,inside_95,truth_d2,answers_d2,lens_d2",
        "handeye-boards",
    )().query("`truth d2` != ''"),
    "handeye: a thing in the gripper": _rows(
        "condition,method,draws,refused,mm,mm_90,deg,sigma_mm,inside_95,squared_mahalanobis",
        "eye-to-hand",
    ),
    "arm-in-view: conditions": _rows(
        "condition,draws,refused,warned,mm,mm_90,deg,sigma_mm,inside_95,wrong,seconds",
        "arm-in-view",
    ),
    "arm-in-view: parts": _rows(
        "condition,draws,mm,mm_90,deg,sigma_mm,inside_95,squared_mahalanobis",
        "arm-in-view-parts",
    ),
    "arm-in-view: beside": _rows(
        "condition,draws,refused,mm,deg,sigma_mm,sigma_deg,seconds",
        "arm-in-view-beside",
    ),
    "arm-in-view: audit": _rows(
        "mistake,poses,right,wrong,unknown,named,within,median_mm,median_deg,seconds",
        "audit",
    ),
    "boards: mistakes": _rows("mistake,draws,refused,warned,named,safe", "mistakes"),
    "boards: detection": _rows(
        "board,tilt_deg,finder,found,any_of_opencv,rms_px,ms", "boards"
    ),
    "results: cameras from images": _trials,
    "handeye: bumps": _bump,
    "joints: arms": _rows(
        "condition,method,draws,refused,gripper_before_mm,gripper_after_mm,mm,deg,sigma_mm,"
        "inside_95,fixed_mm,fixed_deg,fixed_inside_95,offset_deg,offset_inside_95,offset_squared",
        "joint-offsets",
    ),
    "scale: retrieval": lambda: _rows(
        "queries,keyframes,first,proposed,four_turns_ms,megabytes", "retrieval"
    )().query("queries == 'box rooms'"),
    "scale: maps": _rows(
        "scenes,open_s,own_mb,images,right,wrong,median_ms", "large-maps"
    ),
    "scale: learning on a cluster": lambda: _rows(
        "way,wall_s,processor_s,killed,same_map", "cluster"
    )().query("`wall s` != ''"),
    "scale: serving from a cluster": lambda: _rows(
        "way,images_per_s,median_ms,processor_ms,same_answers", "cluster"
    )().query("`median ms` != ''"),
    "fisheye: lenses": _rows(
        "answer,rooms,map,asked,number,located,mm,mm_90,inside_95,wrong", "fisheye"
    ),
    "real-rooms: guard": _guard,
    "tests: mutants": _mutants,
    "intrinsics: another camera of the model": _rows(
        "answer,camera,stated,answers,located,median_mm,95_%_mm,sigma_mm,inside_95_%,wrong",
        "same-model",
    ),
    "map: stores of many rooms": _accuracy(
        _ROOMS,
        [
            ("sim-mini at 640x480, two of its rooms", "large", "bedroom,kitchen"),
            (
                "sim-7, in a store of sixteen rooms",
                "sixteen",
                "bedroom-1,bedroom-2,bedroom-3,kitchen-1,kitchen-2,living-1,living-2",
            ),
            ("sim-mini, the same store", "sixteen", "bedroom,kitchen,living"),
            (
                "six rooms of sim-12, the same store",
                "sixteen",
                "twelve-bedroom-1,twelve-bedroom-2,twelve-kitchen-1,twelve-kitchen-2,"
                "twelve-living-1,twelve-living-2",
            ),
            (
                "sim, its three rooms, 1,000 frames each",
                "long",
                "bedroom,kitchen,living",
            ),
        ],
    ),
    "streams: refresh": _rows(
        "room,round,map,images,within_1_cm,median_mm,inside_95,keyframes,kB,drift_mm,"
        "stated_sigma_mm,seconds",
        "refresh",
    ),
    "streams: tracking": _rows(
        "image,budget_ms,frames,lost,frames_until_found,wrong_10_mm,median_mm,p95_mm,"
        "single_median_mm,ms_p50,ms_p99,over_budget,per_second,single_ms_p50",
        "tracking",
    ),
    "network: three rooms": network_tables.summary("networks-a"),
    "network: contrasts": network_tables.contrasts,
    "network: machines": network_tables.environments,
    "network-checks: unseen rooms": network_tables.summary("networks-c"),
    "network-checks: unseen rooms, one run": network_tables.summary(
        "networks-c", single=True
    ),
    "network-checks: 240 pixels": network_tables.summary("networks-d-240", single=True),
    "network-checks: 480 pixels": network_tables.summary("networks-d", single=True),
    "network-checks: the paper's network": network_tables.summary(
        "networks-paper", single=True
    ),
    "network-checks: the paper's head": network_tables.summary("networks-b"),
    "network-checks: memory": network_tables.memory,
    "network-checks: real rooms": network_tables.summary("networks-real"),
    "network-trials: ideas": network_tables.summary("networks-ideas", single=True),
    "network-trials: beyond": network_tables.summary("networks-beyond", single=True),
    "network-trials: units of positions": _rows(
        "room,frames,side,metre,axes,reach,deviation", "sars-units"
    ),
    "network-trials: tuning": _tuning("tuned-converged", "sim-tune"),
    "network-trials: tuning, head": _tuning("tuned-paper-head", "sim-tune"),
}
"""Tables by page and title."""
