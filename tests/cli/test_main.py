"""Help, version, messages, exit codes and output paths of all verbs."""

import ast
import itertools
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

import evercal
from evercal.cli import VERBS, main

ALL = list(itertools.chain(*VERBS.values()))
OTHER_PROGRAMS = (
    "--once --frame-id --child-frame-id --qw --qx --qy --qz --nproc-per-node"
)
OTHER_PROGRAMS += " --tyro-print-completion --version"
"""Options in messages that are not those of a verb."""
SOLVE = "--robot-poses R --camera-poses C --mount eye_in_hand"


def alone(*words: str) -> tuple[subprocess.CompletedProcess[str], set[str], float]:
    """A command in its own process, the modules it loaded, and its seconds."""
    code = (
        "import sys; from evercal.cli import main; code = main(sys.argv[1:]);"
        "print('\\nmodules', *sys.modules, file=sys.stderr); sys.exit(code)"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=60
    )
    modules = set(done.stderr.rpartition("\nmodules ")[2].split())
    return done, modules, time.perf_counter() - start


def test_help_lists_every_verb_once_in_its_group():
    done, modules, seconds = alone("--help")
    assert done.returncode == 0
    groups: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        if heading := re.fullmatch(r"(\w.*):", line):
            groups[heading[1]] = []
        elif verb := re.match(r"  (\S+)\s+[A-Z]\w+", line):
            groups[list(groups)[-1]].append(verb[1])
    assert groups == VERBS
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert not {"torch", "cv2", "scipy", "matplotlib", "numpy"} & modules
    assert seconds < 5  # one second where nothing else runs


INDENT = "│" + 15 * " "


@pytest.mark.parametrize("verb", ALL)
def test_help_of_a_verb_fits_and_has_an_example(run, verb, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    ran = run(verb, "--help")
    assert (ran.code, ran.err) == (0, [])
    assert re.search(rf"^Example: evercal {verb} ", ran.out, re.MULTILINE)
    assert max(map(len, ran.out.splitlines())) <= 80
    for line, after in itertools.pairwise(ran.out.splitlines()):
        if line.startswith(INDENT) and after.startswith(INDENT):
            words = after.strip("│ ").split()
            assert len(line.rstrip("│ ")) + len(words[0]) >= 77, line
    assert "(default: None)" not in ran.out
    assert "(default: )" not in ran.out
    assert "--no-" not in ran.out
    assert "--json" in ran.out
    if verb == "learn":
        assert "--preset {fast,demo,bench,converged,paper}" in ran.out


def test_messages_name_existing_options(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    options = set(OTHER_PROGRAMS.split())
    for words in (*ALL, "map merge"):
        page = run(words, "--help").out
        options |= set(re.findall(r"^│ (?:-h, )?(--[a-z-]+)", page, re.MULTILINE))
    assert "--robot-poses" in options
    for path in Path(evercal.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*[a-z]", node.value))
                assert named <= options, f"{path}:{node.lineno}"


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["learn", "--help"], 0),
        (["localize", "store", "missing.png"], 2),
        (["export", "missing.json", "--format", "urdf"], 2),
    ],
)
def test_help_and_misuse_do_without_torch(words, code):
    done, modules, _ = alone(*words)
    assert done.returncode == code
    assert not {"torch", "matplotlib"} & modules


def test_version(run):
    assert run("--version").out == f"evercal {evercal.__version__}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("learn store", "RECORDING"),
        ("learn a b --seed x", "--seed"),
        ("learn a b --preset slow", "--preset"),
        ("detect x --board apriltag --camra c", "--camera FILE"),
        ("lern", "lern: no such verb; did you mean 'learn'?"),
        ("qqqq", "'evercal --help' lists all verbs"),
    ],
)
def test_unusable_arguments_are_an_error_object(run, words, message):
    ran = run(words, "--json")
    assert ran.code == 2
    assert message in ran.json["error"]
    assert message in "".join(ran.err)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "learn S R --calibration GONE/c.json",
            "--calibration GONE/c.json: folder",
        ),
        ("learn S R --calibration DIR", "--calibration DIR: is a folder"),
        (
            "localize S IMAGE --overlay FILE/x",
            "--overlay FILE/x: cannot be created",
        ),
        (
            "calibrate S IMAGE --out GONE/c.json",
            "--out GONE/c.json: folder",
        ),
        ("calibrate S IMAGE --out DIR", "--out DIR: is a folder"),
        (
            "detect IMAGE --board apriltag --out GONE/b.json",
            "--out GONE/b.json",
        ),
        (f"solve {SOLVE} --out GONE/c.json", "--out GONE/c.json: folder"),
        ("report C --out GONE/r.html", "--out GONE/r.html: folder"),
        ("convert R FILE", "FILE: is a file; give a folder"),
        ("demo --out FILE/x", "--out FILE/x: cannot be created"),
        ("demo --copy-samples FILE", "FILE: is a file; name a new folder"),
        ("simulate cell --out FILE/x", "FILE/x"),
        ("bench sim-mini --out FILE/x", "FILE/x"),
    ],
)
def test_output_paths_are_refused_before_the_work(run, words, message, tmp_path):
    """The inputs do not exist, but the message is about the output."""
    (tmp_path / "FILE").write_text("x")
    (tmp_path / "DIR").mkdir()
    image = Path(evercal.__file__).parent / "recordings" / "sample_cell" / "bumped.jpg"
    message = re.sub("(GONE|DIR|FILE)", rf"{tmp_path}/\1", message)
    words = re.sub(r"(?<= )(GONE|DIR|FILE)", rf"{tmp_path}/\1", words)
    began = time.monotonic()
    ran = run(words.replace("IMAGE", str(image)))
    assert (ran.code, ran.out) == (2, "")
    assert message in ran.err[-1]
    assert time.monotonic() - began < 10
    assert sorted(path.name for path in tmp_path.iterdir()) == ["DIR", "FILE"]


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no /dev/full"
)
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--version"],
            f"standard output or {tempfile.gettempdir()}: No space left on device",
        ),
        (["info", "x", "--json"], "x: no such folder"),
    ],
)
def test_full_disk_is_one_line(words, message):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "evercal", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert done.returncode == 2
    assert done.stderr == f"error: {message}\n"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission_is_refused(run, tmp_path):
    tmp_path.chmod(0o500)
    run.refused("demo --copy-samples", tmp_path / "samples")


def test_bugs_are_not_reported_as_bad_input(monkeypatch):
    monkeypatch.setitem(sys.modules, "tyro", None)  # a broken installation
    with pytest.raises(ImportError):
        main(["info", "x"])


def test_closed_stdout_is_no_error() -> None:
    command = [sys.executable, "-m", "evercal", "--version"]
    closing = "import os, sys; os.close(1); os.execv(sys.argv[1], sys.argv[1:])"
    words = [sys.executable, "-c", closing, *command]
    ended = subprocess.run(words, stderr=subprocess.PIPE, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_closed_pipe_has_the_status_of_other_programs_and_no_traceback():
    with subprocess.Popen(
        [sys.executable, "-m", "evercal", "--help"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(timeout=60) == 141
