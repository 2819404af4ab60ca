"""Help, version, complaints and exit codes; none of them waits for torch."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import evercal
from evercal import cli
from evercal.errors import InputError

VERBS = (
    "demo",
    "learn",
    "localize",
    "calibrate",
    "check",
    "watch",
    "audit",
    "align",
    "detect",
    "solve",
    "export",
    "report",
    "evaluate",
    "info",
    "verify",
    "inspect",
    "convert",
    "simulate",
    "bench",
    "bench-report",
    "pretrain",
)


def alone(*words: str) -> tuple[subprocess.CompletedProcess[str], set[str], float]:
    """A command in a process of its own, the modules it loaded, and its seconds."""
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


def test_help_lists_every_verb_at_once() -> None:
    done, modules, seconds = alone("--help")
    assert done.returncode == 0
    assert tuple(re.findall(r"^│\s+• (\S+)", done.stdout, re.MULTILINE)) == VERBS
    assert not {"torch", "cv2", "scipy", "matplotlib", "numpy"} & modules
    assert seconds < 5  # one second where nothing else runs


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["learn", "--help"], 0),
        (["localize", "--help"], 0),
        (["evaluate", "--help"], 0),
        (["demo", "--help"], 0),
        (["learn", "store"], 2),
        (["learn", "store", "scene", "--preset", "slow"], 2),
        (["learn", "store", "scene", "--memory", "none"], 2),
        (["localize", "store"], 2),
        (["localize", "store", "missing.png"], 2),
        (["evaluate", "store"], 2),
        (["evaluate", "store", "missing"], 2),
        (["export", "--help"], 0),
        (["export", "missing.json", "--format", "urdf"], 2),
        (["lern"], 2),
        ([], 2),
    ],
)
def test_help_and_misuse_do_without_torch(words: list[str], code: int) -> None:
    done, modules, _ = alone(*words)
    assert done.returncode == code
    assert not {"torch", "cv2", "matplotlib"} & modules


def test_arguments_have_names_and_explanations(run: Any) -> None:
    text = " ".join(run("learn", "--help").out.replace("│", " ").split())
    for option in ("name", "strategy", "preset", "memory", "centres", "encoder", "format", "seed"):
        assert f"--{option} " in text
    assert "STORE SCENE" in text
    assert "Folder of the recorded scene," in text
    assert "--no-json" not in text


def test_presets_in_the_help_are_those_there_are(run: Any) -> None:
    from evercal.continual.presets import PRESETS

    text = " ".join(run("learn", "--help").out.replace("│", " ").split())
    assert f"--preset {{{','.join(PRESETS)}}}" in text


def test_the_page_on_methods_names_every_strategy_and_no_other() -> None:
    from evercal.continual.strategies import STRATEGIES

    page = (Path(__file__).parents[2] / "docs" / "methods.md").read_text()
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    # Other tests may have composed some more.
    listed = {name for name in STRATEGIES if name.isidentifier()}
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == listed


def test_version(run: Any) -> None:
    assert run("--version").out == f"evercal {evercal.__version__}\n"


def test_unusable_arguments_are_an_error_object_too(run: Any) -> None:
    ran = run("learn", "store", "--json")
    assert ran.code == 2
    assert "SCENE" in json.loads(ran.out)["error"]
    assert "SCENE" in "".join(ran.err)
    ran = run("learn", "a", "b", "--seed", "x", "--json")
    assert "--seed" in json.loads(ran.out)["error"]


class Fails:
    def __init__(self, error: BaseException):
        self.error = error

    def run(self) -> int:
        raise self.error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("scene 'a'\nis bad"), 2, "error: scene 'a' is bad"),
        (PermissionError(13, "Permission denied", "/x/y"), 2, "error: /x/y: Permission denied"),
        (OSError(28, "No space left on device"), 2, "error: No space left on device"),
        (KeyboardInterrupt(), 130, "stopped"),
    ],
)
def test_errors_are_one_line_and_an_exit_code(
    run: Any, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, said: str
) -> None:
    monkeypatch.setattr(cli, "_parse", lambda words, as_json: Fails(error))
    ran = run("info", "x")
    assert (ran.code, ran.err, ran.out) == (code, [said], "")
    if code == 2:
        assert json.loads(run("info", "x", "--json").out) == {"error": said[len("error: ") :]}


def test_a_bug_is_not_dressed_up_as_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "_parse", lambda words, as_json: Fails(ValueError("bug")))
    with pytest.raises(ValueError, match="bug"):
        cli.main(["info", "x"])


def test_a_reader_that_leaves_early_is_no_error(tmp_path: Path) -> None:
    code = "import sys; from evercal.cli import main; sys.exit(main(['--help']))"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(timeout=60) == 0
