"""The command line: one verb per file; `main` runs a verb and prints errors as one line.

Only the module of the verb is loaded, and no verb loads large libraries before it runs, so that
help and argument errors appear at once.
"""

import contextlib
import difflib
import importlib
import io
import itertools
import os
import platform
import shutil
import sys
import tempfile
import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

from evercal.errors import InputError, printable

VERBS = {
    "Map": [
        "learn",
        "localize",
        "track",
        "view",
        "refresh",
        "evaluate",
        "info",
        "map",
        "serve",
    ],
    "Calibrate": [
        "studio",
        "eye-to-hand",
        "arm-in-view",
        "calibrate",
        "verify",
        "check",
        "watch",
        "audit",
        "align",
    ],
    "Boards and pose pairs": ["detect", "solve"],
    "Results": ["export", "report", "compare"],
    "Recordings": ["record", "inspect", "convert", "reconstruct", "simulate", "demo"],
    "Networks": ["bench"],
}
"""Verbs by purpose, in the order of the help. The class `Learn` of `learn` is in `learn.py`."""

_INDENT = "│" + 15 * " "
"""Before the text of an option in a help page."""
_BROKEN_PIPE = 141
"""Status of a program whose reader has ended: 128 and the number of SIGPIPE."""
_X86 = ("x86_64", "AMD64")
_SAME_ARITHMETIC = {"OPENBLAS_CORETYPE": "Haswell", "MKL_CBWR": "COMPATIBLE"}
"""Matrix products by kernels that every x86 processor with AVX2 has, for `EVERCAL_PRECISION`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: words after `evercal`. Default: those of the process.

    Returns:
        The exit code: 0 done, 1 negative result, 2 misuse or bad input, 130 interrupted,
            141 the reader of the output ended first.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    as_json = "--json" in words
    # Spinning threads of networks take up to ten times as long when other programs use the cores,
    # and save a tenth otherwise. Read once, when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if os.environ.get("EVERCAL_PRECISION") == "float32" and platform.machine() in _X86:
        for name, value in _SAME_ARITHMETIC.items():
            os.environ.setdefault(name, value)
    if sys.stdout is None:  # closed before the start
        sys.stdout = io.TextIOWrapper(io.BytesIO(), "utf-8")
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Its encoding may lack letters of a name; stderr escapes them anyway.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        command = parsed(words, as_json)
        if not isinstance(command, int):
            command.set_limits()
            command = _run(command, words)
        sys.stdout.flush()  # here, where a closed pipe is handled
        return command
    except InputError as error:
        return _complain(str(error), as_json)
    except BrokenPipeError:
        _discard_stdout()  # the reader closed the pipe, perhaps before the work was done
        return _BROKEN_PIPE
    except OSError as error:  # a full disk, a folder that may not be written
        # What writes elsewhere names its file.
        where = error.filename or f"standard output or {tempfile.gettempdir()}"
        try:
            sys.stdout.flush()
        except OSError:
            _discard_stdout()
        return _complain(f"{where}: {error.strerror or error}", as_json)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130


def _run(command: Any, words: Sequence[str]) -> int:
    """Run a verb; what it writes records the command."""
    if not command.writes:
        return command.run()
    from evercal.storage.provenance import call

    with call(("evercal", *words), command.given):
        return command.run()


def _discard_stdout() -> None:
    """Keep Python from writing to a broken stdout again when it exits."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(message: str, as_json: bool) -> int:
    from evercal.cli.console import print_json, say

    message = " ".join(message.split())
    say(f"error: {message}", sys.stderr)
    if as_json:
        try:
            print_json({"error": message})
        except OSError:
            _discard_stdout()
    return 2


def verb_class(name: str) -> Any:
    """The class of a verb."""
    module = importlib.import_module(f"evercal.cli.{name.replace('-', '_')}")
    return getattr(module, name.title().replace("-", ""))


def _help() -> str:
    """The overview of `evercal --help`: verbs by purpose, one line each."""
    lines = ["usage: evercal VERB ...", ""]
    lines.append(
        "Camera poses in the robot base frame from single images; hand-eye calibration."
    )
    for group, names in VERBS.items():
        lines += ["", f"{group}:"]
        for name in names:
            summary = verb_class(name).__doc__.partition("\n\n")[0]
            first = " ".join(summary.split()).partition("; ")[0]
            lines.append(f"  {name:11s} {first.rstrip('.')}")
    lines += [
        "",
        "'evercal VERB --help' lists the options of a verb. Every verb has --json.",
        "Exit codes: 0 done, 1 negative result (not located, moved, not good enough),",
        "2 misuse or bad input. 'evercal --version' prints the version.",
    ]
    return "\n".join(lines)


def parsed(words: list[str], as_json: bool = False) -> Any:
    """The command that the words make, or an exit code."""
    if words == ["--version"]:
        # `evercal` is loaded before its folders, which do not import it.
        print(f"evercal {sys.modules['evercal'].__version__}")
        return 0
    if words in ([], ["--help"], ["-h"]):
        print(_help())
        return 0 if words else 2
    verbs = list(itertools.chain(*VERBS.values()))
    if words[0] not in verbs:
        hint = "'evercal --help' lists all verbs"
        for similar in difflib.get_close_matches(words[0], verbs, 1):
            hint = f"did you mean '{similar}'?"
        raise InputError(f"{words[0]}: no such verb; {hint}")
    import tyro

    caught = io.StringIO()
    # tyro draws frames only on a stream whose encoding has them.
    shown = io.TextIOWrapper(
        io.BytesIO(), sys.stdout.encoding, "replace", write_through=True
    )
    try:
        with contextlib.redirect_stderr(caught), contextlib.redirect_stdout(shown):
            return tyro.cli(
                verb_class(words[0]),
                prog=f"evercal {words[0]}",
                args=words[1:],
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        shown.seek(0)
        _print_wrapped(shown.read())
        sys.stderr.write(printable(caught.getvalue()))
        if stop.code in (0, None):
            return 0
        if as_json:
            from evercal.cli.console import print_json

            print_json({"error": _box_text(caught.getvalue())})
        return 2


def _print_wrapped(page: str) -> None:
    """Print a help page; tyro leaves lines longer than the terminal is wide."""
    columns = shutil.get_terminal_size().columns
    for line in _rejoined(page.splitlines()):
        print("\n".join(textwrap.wrap(line, columns, break_on_hyphens=False)))


def _rejoined(lines: Sequence[str]) -> Iterator[str]:
    """Lines of a help page; tyro breaks the text of an option where its source does."""
    head = ""
    texts: list[str] = []
    for line in [*lines, ""]:
        rest = line[len(_INDENT) : -1].strip()
        if texts and line.startswith(_INDENT):
            texts.append(rest)
            continue
        if texts:
            width = len(lines[-1]) - len(_INDENT) - 2
            for text in textwrap.wrap(" ".join(texts), width, break_on_hyphens=False):
                yield f"{head}{text:{width}} │"
                head = _INDENT
        head = line[: len(_INDENT)]
        texts = []
        # A long name stands in a line of its own.
        if head.startswith("│") and head.endswith("  "):
            texts.append(rest)
        else:
            yield line


def _box_text(box: str) -> str:
    """The paragraphs of tyro's framed message as one line, without the last one, on --help."""
    lines = [line.strip("│ ") for line in box.splitlines()[1:]]
    paragraphs = []
    for paragraph in " ".join(lines).split("──"):
        words = paragraph.strip("─╰╯ ").split()
        if words:
            paragraphs.append(" ".join(words))
    text = "; ".join(paragraphs).partition("; For full help")[0]
    return text or "unusable arguments"
