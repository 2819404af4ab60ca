"""The wheel contains everything the package reads."""

import os
import re
import subprocess
import sys
import zipfile
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evercal"
DATA = (
    "py.typed",
    "features/weights/*.onnx",
    "features/weights/*.safetensors",
    "recordings/sample_cell/**/*.*",
    "recordings/sample_rooms/**/*.*",
    "reports/templates/*.html",
)
"""Files beside the modules, relative to the package."""


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the wheel and the sdist that `python -m build` makes."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out))
    return out


@pytest.fixture(scope="module")
def wheel(distributions: Path) -> set[str]:
    """Names in the wheel."""
    (path,) = distributions.glob("evercal-*.whl")
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def run(*command: str, cwd: Path = ROOT) -> str:
    """What a command prints that knows nothing of this checkout."""
    environment = {**os.environ, "PYTHONPATH": ""}
    done = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("pattern", DATA)
def test_wheel_contains_the_data(wheel: set[str], pattern: str) -> None:
    files = [path for path in PACKAGE.glob(pattern) if path.is_file()]
    assert files
    assert {path.relative_to(ROOT / "src").as_posix() for path in files} <= wheel


def test_wheel_contains_every_module_and_nothing_else(wheel: set[str]) -> None:
    modules = {
        path.relative_to(ROOT / "src").as_posix() for path in PACKAGE.rglob("*.py")
    }
    assert modules <= wheel
    assert {name.split("/")[0].split("-")[0] for name in wheel} == {"evercal"}
    assert not [
        name for name in wheel if name.startswith("evercal/") and "test" in name
    ]


def brought(name: str, extras: frozenset[str], found: dict[str, str]) -> dict[str, str]:
    """Versions of a distribution and of all that its installation brings, by name."""
    # Of another system, or of a tool that is not installed.
    try:
        installed = distribution(name)
    except PackageNotFoundError:
        return found
    found[canonicalize_name(name)] = installed.version.partition("+")[0]
    for line in installed.requires or ():
        wanted = Requirement(line)
        key = canonicalize_name(wanted.name)
        applies = wanted.marker is None or any(
            wanted.marker.evaluate({"extra": extra}) for extra in (*extras, "")
        )
        if applies and (key not in found or wanted.extras):
            brought(wanted.name, frozenset(wanted.extras), found)
    return found


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = (line.split("==") for line in lines if not line.startswith("#"))
    return {canonicalize_name(name): version for name, version in pairs}


def test_every_version_that_an_installation_brings_is_pinned() -> None:
    everything = brought("evercal", frozenset({"dev"}), {})
    del everything["evercal"]
    assert len(everything) > 120
    pinned = pins()
    lacking = {n: v for n, v in everything.items() if pinned.get(n) != v}
    assert not lacking, "constraints.txt was made from other versions"


def test_the_licence_of_every_package_is_listed() -> None:
    page = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| .+? \| (.*) ?\|$", page, re.M)
    names = re.findall(r"[\w.-]+", " ".join(cells))
    listed = {canonicalize_name(name) for name in names}
    for extras in (
        (),
        (
            "bags",
            "boards",
            "colmap",
            "droid",
            "lerobot",
            "networks",
            "ray",
            "serve",
            "urdf",
            "view",
        ),
    ):
        everything = brought("evercal", frozenset(extras), {})
        assert everything.keys() - {"evercal"} <= listed


@pytest.mark.slow("pyproject.toml", "README.md", "src/evercal/cli/demo.py")
def test_the_wheel_runs_in_an_empty_environment(
    distributions: Path, tmp_path: Path
) -> None:
    """The wheel alone runs the demo, and both files can be published."""
    files = sorted(map(str, distributions.glob("evercal-*")))
    run(sys.executable, "-m", "venv", str(tmp_path / "empty"))
    python = str(tmp_path / "empty" / "bin" / "python")
    pins = str(ROOT / "constraints.txt")
    run(python, "-m", "pip", "install", "-c", pins, files[0], "twine", cwd=tmp_path)
    assert run(python, "-m", "twine", "check", "--strict", *files).count("PASSED") == 2
    where = run(python, "-c", "import evercal; print(evercal.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(tmp_path)
    evercal = str(tmp_path / "empty" / "bin" / "evercal")
    run(evercal, "demo", cwd=tmp_path)
    assert (tmp_path / "evercal-demo" / "report.html").is_file()
