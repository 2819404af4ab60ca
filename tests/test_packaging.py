"""The wheel contains everything the package reads."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evercal"
DATA = (
    "py.typed",
    "features/weights/*.safetensors",
    "recordings/sample_cell/**/*.*",
    "recordings/sample_rooms/**/*.*",
    "reports/templates/*.html",
)
"""Files beside the modules, relative to the package."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names in the wheel of `python -m build`."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (path,) = out.glob("evercal-*.whl")
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


@pytest.mark.parametrize("pattern", DATA)
def test_wheel_contains_the_data(wheel: set[str], pattern: str) -> None:
    files = [path for path in PACKAGE.glob(pattern) if path.is_file()]
    assert files
    assert {path.relative_to(ROOT / "src").as_posix() for path in files} <= wheel


def test_wheel_contains_every_module_and_nothing_else(wheel: set[str]) -> None:
    modules = {path.relative_to(ROOT / "src").as_posix() for path in PACKAGE.rglob("*.py")}
    assert modules <= wheel
    assert {name.split("/")[0].split("-")[0] for name in wheel} == {"evercal"}
    assert not [name for name in wheel if name.startswith("evercal/") and "test" in name]
