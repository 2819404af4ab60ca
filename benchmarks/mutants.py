"""How good are the tests? Small changes of the code, drawn from a seed, that they should notice.

Why no package does this: mutmut 3.8.1 (BSD-3) has no seed and no sample, leaves out constants of
modules and decorated functions such as properties, and forks a process that has loaded OpenCV.
cosmic-ray 8.7.0 (MIT) changes files in place and runs one command for all mutants. mutatest 3.1.0
(MIT) has seeds and samples, but was last released in 2022 and asks for coverage < 6.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pandas as pd
from tyro.conf import Positional

from benchmarks.mutation import drawn
from benchmarks.rows import Row, once, save, show
from evercal.errors import InputError
from evercal.processes import python_command

ROOT = Path(__file__).resolve().parents[1]
JUDGED = ROOT / "results" / "mutants-judged.csv"
"""Survivors that compute the same, each with the reason."""
_PYTEST = ("-q", "-x", "-n0", "-p", "no:cacheprovider", "-m", "not slow and not gpu")
"""Slow tests are left out."""
_LIMIT_S = 600.0
"""Seconds after which tests do not end any more."""


def run(
    files: Positional[tuple[Path, ...]],
    seed: int = 1,
    count: int = 12,
    tests: tuple[Path, ...] = (),
    seconds: float = 180.0,
    out: Path = Path("runs/mutants"),
) -> None:
    """Change files in a copy of the source, and run the tests that execute the changed lines.

    A run that was stopped goes on where it was, unless the source or the tests have changed.

    Args:
        files: Files of `src`.
        seed: Seed of the draw; each file has its own.
        count: Mutants of each file.
        tests: Files or folders of tests that may notice; if omitted, the folders of `tests` that
            are named like those of the files.
        seconds: Tests of a mutant, at most: the file named like the mutated one first, then files
            that take less time.
        out: Folder for the rows, and what they come from.
    """
    names = [file.resolve().relative_to(ROOT).as_posix() for file in files]
    tree = out.resolve() / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(ROOT / "src", tree / "src")
    executed = dict[str, Row]()
    for folder in tests or {Path("tests", *Path(name).parts[2:3]) for name in names}:
        for file in sorted(folder.rglob("test_*.py")) or [folder]:
            executed[str(file)] = _executed(tree, str(file), names)
    rows = []
    for name in names:
        for mutant in drawn((tree / name).read_text("utf-8"), count, f"{seed} {name}"):
            chosen = _chosen(executed, tree / name, mutant.line, seconds)
            row: Row = {"seed": seed, "file": name, "tests": len(chosen)}
            row |= {"line": mutant.line, "function": mutant.function}
            row["change"] = mutant.change
            row["outcome"] = _outcome(tree, tree / name, mutant.source, chosen)
            print(*row.values(), flush=True)
            rows.append(row)
    judged = pd.read_csv(JUDGED, keep_default_na=False)
    table = pd.DataFrame(rows).merge(judged, "left")
    same = table["why"].notna() & (table["outcome"] == "survived")
    table.loc[same, "outcome"] = "equivalent"
    settings = {"seed": seed, "count": count, "seconds": seconds}
    save(out / "mutants.csv", table.to_dict("records"), settings)
    show(pd.crosstab(table["file"], table["outcome"], margins=True).reset_index())


def _executed(tree: Path, test: str, names: Sequence[str]) -> Row:
    """Lines that a file of tests executes, and its seconds."""
    files = [str(tree / name) for name in names]

    def measure() -> Row:
        began = time.perf_counter()
        if _status(tree, files, [test]) not in (0, 5):
            raise InputError(f"{test} fails without a mutant; see {tree}/output.txt")
        lines = (tree / "lines.json").read_text()
        return {"lines": lines, "seconds": time.perf_counter() - began}

    return once(_kept(tree, [*files, test]), measure)


def _chosen(
    executed: dict[str, Row], file: Path, line: int, seconds: float
) -> list[str]:
    """Files of tests that execute a line, or else its file; at most so many seconds of them."""
    own = f"test_{file.name}"
    found = []
    for test, row in executed.items():
        lines = json.loads(str(row["lines"]))[str(file)]
        if lines:
            order = (line not in lines, Path(test).name != own, row["seconds"], test)
            found.append(order)
    if not found:
        raise InputError(f"no test executes {file.name}; name others by --tests")
    chosen = list[str]()
    for elsewhere, _, time_s, test in sorted(found):
        seconds -= float(time_s)
        if not chosen or (seconds > 0 and elsewhere == min(found)[0]):
            chosen.append(test)
    return chosen


def _outcome(tree: Path, file: Path, source: str, chosen: Sequence[str]) -> str:
    """Whether a test fails with another source of a file."""

    def measure() -> Row:
        before = file.read_bytes()
        file.write_text(source, "utf-8")
        status = _status(tree, [], chosen)
        file.write_bytes(before)
        return {"outcome": "killed" if status else "survived"}

    files = [*map(str, sorted(tree.rglob("*.py"))), *chosen]
    return str(once(_kept(tree, files, source), measure)["outcome"])


def _kept(tree: Path, files: Sequence[str], words: str = "") -> Path:
    """The file for what was measured with these files."""
    digest = hashlib.sha256("\0".join([*files, words]).encode())
    for file in files:
        digest.update(Path(file).read_bytes())
    return tree.parent / f"{digest.hexdigest()[:16]}.json"


def _status(tree: Path, files: Sequence[str], tests: Sequence[str]) -> int:
    """Exit status of pytest with the copied source; -9 if it does not end."""
    # A mutant may have the size and the second of the file before, so no bytecode is kept.
    paths = f"{tree / 'src'}{os.pathsep}{ROOT}"
    variables = {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPATH": paths}
    command = ["-m", "benchmarks.executed", str(tree / "lines.json"), *files, "--"]
    with (
        open(tree / "output.txt", "wb") as output,
        subprocess.Popen(
            python_command(*command, *_PYTEST, *tests),
            env=os.environ | variables,
            stdout=output,
            stderr=output,
            start_new_session=True,
        ) as process,
    ):
        with suppress(subprocess.TimeoutExpired):
            process.wait(_LIMIT_S)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        return process.wait()
