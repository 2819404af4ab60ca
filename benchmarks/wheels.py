"""Wheels of every pinned package, for the platforms and Pythons of docs/install.md.

uv resolves the base and each extra with constraints.txt, for all platforms at once, and lists the
wheels that the index has. packaging compares them with the tags of a platform, and the markers of
dependencies with its variables. Nothing is installed or built.
"""

import functools
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import uv
from packaging import tags
from packaging.pylock import Package, Pylock
from packaging.utils import parse_wheel_filename

from evercal.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
"""Versions that the page promises, each from its first release on."""
BASE = "base"
"""What is installed without an extra."""
_GLIBC = 35
"""Minor version of the glibc 2 of Ubuntu 22.04 and JetPack 6, the oldest promised."""
_MACOS = (14, 0)
"""Oldest promised macOS."""
_INDEX = re.compile(r"^(?:global|install|:env:)\.index-url='(.*)'$", re.M)


class Platform(NamedTuple):
    """What decides about wheels and markers."""

    system: str
    sys_platform: str
    machine: str
    names: tuple[str, ...]
    """Platforms in the tags of wheels that it accepts."""

    def environment(self, python: str) -> dict[str, str]:
        """Values of the variables of markers that can differ."""
        return {
            "os_name": "nt" if self.system == "Windows" else "posix",
            "platform_machine": self.machine,
            "platform_system": self.system,
            "python_full_version": f"{python}.0",
            "python_version": python,
            "sys_platform": self.sys_platform,
        }

    def supported(self, python: str) -> set[tags.Tag]:
        """Tags of the wheels that CPython installs."""
        major, minor = map(int, python.split("."))
        version = (major, minor)
        interpreter = f"cp{major}{minor}"
        own = tags.cpython_tags(version, platforms=self.names)
        return {*own, *tags.compatible_tags(version, interpreter, self.names)}


def _linux(machine: str) -> Platform:
    versions = [f"manylinux_2_{minor}" for minor in range(5, _GLIBC + 1)]
    names = [*versions, "manylinux1", "manylinux2010", "manylinux2014"]
    accepted = (f"{name}_{machine}" for name in names)
    return Platform("Linux", "linux", machine, (*accepted,))


PLATFORMS = {
    "Linux x86-64": _linux("x86_64"),
    "Linux arm64": _linux("aarch64"),
    "macOS arm64": Platform(
        "Darwin", "darwin", "arm64", (*tags.mac_platforms(_MACOS, "arm64"),)
    ),
    "Windows x86-64": Platform("Windows", "win32", "AMD64", ("win_amd64",)),
}
"""Promised platforms, as the page names them."""


Lacks = dict[str, dict[str, list[str]]]
"""Names of packages without a wheel, of each platform and Python."""


def run() -> None:
    """Print the table of docs/install.md: what lacks wheels on which platform."""
    print(markdown(lacks()))


def lacks() -> dict[str, Lacks]:
    """Ask the index about the base and each extra of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = (BASE, *sorted(project["optional-dependencies"]))
    return {extra: lacking(resolved(extra)) for extra in extras}


def markdown(found: dict[str, Lacks]) -> str:
    """The table of the page."""
    lines = [f"| | {' | '.join(PLATFORMS)} |", "|---" * (len(PLATFORMS) + 1) + "|"]
    for extra, platforms in found.items():
        head = extra if extra == BASE else f"`{extra}`"
        cells = [_cell(of_python) for of_python in platforms.values()]
        lines.append(f"| {' | '.join([head, *cells])} |")
    return "\n".join(lines)


def _cell(of_python: dict[str, list[str]]) -> str:
    texts = {}
    for python, names in of_python.items():
        texts[python] = f"no {', '.join(names)}" if names else "yes"
    if len({*texts.values()}) == 1:
        return texts[PYTHONS[0]]
    return "; ".join(f"{python}: {text}" for python, text in texts.items())


def lacking(packages: list[Package]) -> Lacks:
    """Names of the packages that an installation needs and that have no wheel for it."""
    names: Lacks = {name: {python: [] for python in PYTHONS} for name in PLATFORMS}
    supported = {
        (name, python): platform.supported(python)
        for name, platform in PLATFORMS.items()
        for python in PYTHONS
    }
    for package in packages:
        files = [wheel.filename for wheel in package.wheels or ()]
        offered = {tag for file in files for tag in parse_wheel_filename(file)[-1]}
        for name, platform in PLATFORMS.items():
            for python in PYTHONS:
                marker = package.marker
                needed = not marker or marker.evaluate(platform.environment(python))
                if needed and offered.isdisjoint(supported[name, python]):
                    names[name][python].append(package.name)
    return names


def resolved(extra: str) -> list[Package]:
    """The packages that an extra brings with the base, each with its wheels and its marker.

    Raises:
        InputError: The index does not answer, no versions fit, or a package has no wheel at all.
    """
    command = [uv.find_uv_bin(), "pip", "compile", "pyproject.toml"]
    command += ["--constraints", "constraints.txt", "--format", "pylock.toml"]
    command += ["--universal", "--python-version", PYTHONS[0]]
    command += ["--only-binary", ":all:", "--no-header", "--quiet", "--system-certs"]
    command += ["--default-index", index()]
    if extra != BASE:
        command += ["--extra", extra]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"{extra}: {' '.join(done.stderr.split())}")
    return list(Pylock.from_dict(tomllib.loads(done.stdout)).packages)


@functools.cache
def index() -> str:
    """Address of the index that pip uses."""
    command = [sys.executable, "-m", "pip", "config", "list"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    found = _INDEX.findall(listed)
    return found[-1] if found else "https://pypi.org/simple"
