"""What docs/install.md promises about wheels is what the index has."""

import urllib.request

import pytest
from packaging.pylock import Package, Pylock

from benchmarks import wheels
from benchmarks.wheels import BASE, PLATFORMS, PYTHONS, ROOT, lacking
from evercal.errors import NO_WHEELS

NOTHING = {python: list[str]() for python in PYTHONS}


def test_the_index_has_what_is_promised() -> None:
    """By the page, by the extra `dev`, and by errors: they know which extra has no wheels."""
    try:
        urllib.request.urlopen(f"{wheels.index()}/uv/", timeout=10).close()
    except OSError as error:
        pytest.skip(f"the index of packages does not answer ({error})")
    lacks = wheels.lacks()
    assert lacks[BASE] == dict.fromkeys(PLATFORMS, NOTHING)
    found = {
        (extra, PLATFORMS[name].system, PLATFORMS[name].machine)
        for extra, platforms in lacks.items()
        for name, of_python in platforms.items()
        if any(of_python.values())
    }
    assert found == NO_WHEELS.keys()
    page = (ROOT / "docs" / "install.md").read_text("utf-8")
    assert wheels.markdown(lacks) in page, "run python -m benchmarks wheels"


def package(name: str, *files: str, marker: str = "") -> Package:
    """An entry of a file that uv writes."""
    entry: dict[str, object] = {"name": name, "version": "1.0"}
    address = f"https://example.org/{name}-1.0-"
    entry["wheels"] = [
        {"url": f"{address}{file}.whl", "hashes": {"sha256": "0"}} for file in files
    ]
    if marker:
        entry["marker"] = marker
    lock = {"lock-version": "1.0", "created-by": "test", "packages": [entry]}
    return Pylock.from_dict(lock).packages[0]


@pytest.mark.parametrize(
    ("one", "expected"),
    [
        (package("pure", "py3-none-any"), []),
        (package("stable", "cp310-abi3-manylinux_2_28_aarch64"), []),
        (package("old", "cp313-cp313-manylinux2014_aarch64"), []),
        (package("other", "cp313-cp313-manylinux_2_28_x86_64"), ["other"]),
        (package("new", "cp313-cp313-manylinux_2_39_aarch64"), ["new"]),
        (package("musl", "cp313-cp313-musllinux_1_2_aarch64"), ["musl"]),
        (package("python", "cp312-cp312-manylinux_2_28_aarch64"), ["python"]),
        (package("win", "py3-none-win32", marker="sys_platform == 'win32'"), []),
        (
            package("arm", "py3-none-win32", marker="platform_machine == 'aarch64'"),
            ["arm"],
        ),
        (package("later", "py3-none-win32", marker="python_version >= '3.14'"), []),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_package_counts_where_it_is_needed(one: Package, expected: list[str]) -> None:
    assert lacking([one])["Linux arm64"]["3.13"] == expected


def test_pythons_that_differ_are_named() -> None:
    platforms = dict.fromkeys(PLATFORMS, NOTHING)
    platforms["macOS arm64"] = NOTHING | {"3.14": ["ray", "torch"]}
    lacking = "3.11: yes; 3.12: yes; 3.13: yes; 3.14: no ray, torch"
    line = wheels.markdown({"ray": platforms}).splitlines()[-1]
    assert line == f"| `ray` | yes | yes | {lacking} | yes |"
