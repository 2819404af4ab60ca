"""Run tests with bounded memory, and note which lines of some files they execute.

`python -m benchmarks.executed LINES.json FILE... -- arguments of pytest`. Lines of modules and
classes, which run once at import, are left out.
"""

import json
import resource
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

_BYTES = 6 * 2**30
"""Address space: a mutant of a bound must not take the memory of the machine."""
_OPTIMISED = 1
"""The flag of a function's code."""


def main(out: str, *words: str) -> int:
    """Return the exit status of pytest."""
    resource.setrlimit(resource.RLIMIT_AS, (_BYTES, _BYTES))
    middle = words.index("--")
    lines = {file: set[int]() for file in words[:middle]}

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        code = frame.f_code
        if code.co_filename in lines and code.co_flags & _OPTIMISED:
            lines[code.co_filename].add(frame.f_lineno)
            return trace
        return None

    if lines:
        threading.settrace(trace)
        sys.settrace(trace)
    status = pytest.main([*words[middle + 1 :]])
    found = {file: sorted(numbers) for file, numbers in lines.items()}
    Path(out).write_text(json.dumps(found))
    return status


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
