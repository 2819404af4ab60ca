"""The documentation site builds without a warning, and every page is in its navigation."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import evercal
from evercal import cli

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NAVIGATION = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
OF_THE_ROOT = {"index.md", "changelog.md", "contributing.md", "security.md"}
"""Pages made from files of the repository's root."""
NEEDED = ("mkdocs", "material", "mkdocstrings")


def test_every_page_is_in_the_navigation_once() -> None:
    listed = re.findall(r"[\w/-]+\.md", NAVIGATION)
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(pages | OF_THE_ROOT)


def test_reference_lists_every_public_name_and_verb() -> None:
    python = (DOCS / "reference" / "python.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `evercal\.(\w+)`", python, re.M)) == sorted(
        evercal._PUBLIC
    )
    verbs = (DOCS / "reference" / "command-line.md").read_text(encoding="utf-8")
    grouped = [verb for group in cli.VERBS.values() for verb in group]
    assert re.findall(r"^\| `([\w-]+)`", verbs, re.M) == grouped


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    if missing := [name for name in NEEDED if importlib.util.find_spec(name) is None]:
        pytest.skip(f"the extra `docs` is not installed: no {', '.join(missing)}")
    out = tmp_path_factory.mktemp("site")
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "--quiet",
            "--site-dir",
            str(out),
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not re.search("WARNING|ERROR", done.stdout + done.stderr)
    return out


@pytest.mark.slow("docs", "mkdocs.yml")
def test_site_holds_the_reference(site: Path) -> None:
    python = (site / "reference" / "python.html").read_text(encoding="utf-8")
    for name in evercal._PUBLIC:
        module = getattr(evercal, name).__module__
        assert f'id="{module}.{name}"' in python
    verbs = (site / "reference" / "command-line.html").read_text(encoding="utf-8")
    for verb in ("learn", "localize", "bench"):
        assert f'id="evercal-{verb}"' in verbs
        assert f"usage: evercal {verb}" in verbs


@pytest.mark.slow("docs", "mkdocs.yml")
def test_pages_load_nothing_from_the_internet(site: Path) -> None:
    loads = r"<(?:script|img|iframe|source)[^>]*\ssrc=[\"']?(?:https?:)?//[^\s>\"']+"
    loads += r"|<link[^>]*rel=[\"']?(?:stylesheet|preconnect|icon)"
    loads += r"[^>]*href=[\"']?(?:https?:)?//[^>]+"
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        assert re.findall(loads, page.read_text(encoding="utf-8")) == [], page.name
    for sheet in site.rglob("*.css"):
        assert not re.search(
            r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", sheet.read_text("utf-8")
        )


@pytest.mark.slow("docs", "mkdocs.yml")
def test_start_page_is_the_readme_and_its_links_stay_inside(site: Path) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    assert 'href="results.html"' in start
    assert 'href="contributing.html"' in start
    assert 'href="files/src/evercal/features/weights/pretrain.log"' in start
    assert 'href="../index.html"' in (
        site / "tutorials" / "fixed-camera.html"
    ).read_text(encoding="utf-8")


def test_drawings_are_made_by_their_command(tmp_path: Path) -> None:
    command = [sys.executable, str(DOCS / "_site" / "drawings.py"), str(tmp_path)]
    subprocess.run(command, check=True, timeout=120)
    for name in ("frames.svg", "pixels.svg"):
        drawn, stored = (
            (folder / name).read_text("utf-8") for folder in (tmp_path, DOCS)
        )
        words = [re.findall(r">([^<>\n]+)</text>", text) for text in (drawn, stored)]
        assert words[0] == words[1] != []
