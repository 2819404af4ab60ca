"""Hooks of the site (mkdocs.yml). The pages stay plain Markdown that a code host shows.

- README, CONTRIBUTING, CHANGELOG and SECURITY become pages; README is the start page.
- Links that leave docs/ lead to these pages, or to a copy of the file in the site.
- "```json kitchen/scene.json" becomes a titled block.
- A comment `<!-- help of every verb -->` becomes the help of the command line, and
  `<!-- every public name -->` the reference of the Python interface.
"""

import contextlib
import io
import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).parent))  # MkDocs loads this file alone

ROOT = Path(__file__).parents[2]
ROOT_PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
"""Pages of the repository's root and their names in the site."""
COPIES = "files"
"""Folder of the site for linked files of the repository that are not pages."""
HELP = "<!-- help of every verb -->"
NAMES = "<!-- every public name -->"
COLUMNS = "100"
"""Width of the help texts, characters."""

_LINK = re.compile(r"(\]\()([^)\s#:]+)((?:#[^)\s]*)?\))")
_FENCE = re.compile(r"^(```\w+) +([\w./-]+)$", re.M)


def site_uri(path: str) -> str | None:
    """Name in the site of a file of the repository; None if there is no such file.

    Markdown outside docs/ is copied as text: laboratory notes are no pages of the site.
    """
    if path in ROOT_PAGES:
        return ROOT_PAGES[path]
    if not (ROOT / path).is_file():
        return None
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"{COPIES}/{path}.txt" if path.endswith(".md") else f"{COPIES}/{path}"


def links(markdown: str, source: str) -> dict[str, str]:
    """Relative links of a page that lead to files: link to path in the repository."""
    folder = posixpath.dirname(source)
    paths = {
        m[2]: posixpath.normpath(posixpath.join(folder, m[2]))
        for m in _LINK.finditer(markdown)
    }
    return {link: path for link, path in paths.items() if site_uri(path)}


def with_site_links(markdown: str, source: str) -> str:
    """Replace links to files of the repository by links inside the site."""
    own = site_uri(source)
    known = links(markdown, source)

    def replaced(match: re.Match[str]) -> str:
        if match[2] not in known or own is None:
            return match[0]
        to = site_uri(known[match[2]])
        return (
            match[1]
            + posixpath.relpath(to or "", posixpath.dirname(own) or ".")
            + match[3]
        )

    return _LINK.sub(replaced, markdown)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the root, and the files that pages link to."""
    sources = {name: (ROOT / name).read_text(encoding="utf-8") for name in ROOT_PAGES}
    for name, text in sources.items():
        content = with_site_links(text, name)
        files.append(File.generated(config, ROOT_PAGES[name], content=content))
    for file in files.documentation_pages():
        if file.abs_src_path:
            path = Path(file.abs_src_path)
            sources[path.relative_to(ROOT).as_posix()] = path.read_text(
                encoding="utf-8"
            )
    linked = {
        path
        for source, text in sources.items()
        for path in links(text, source).values()
    }
    for path in sorted(linked):
        uri = site_uri(path) or ""
        if uri.startswith(f"{COPIES}/"):
            files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Turn what code hosts show into what the site shows."""
    if page.file.abs_src_path:  # those of the root were rewritten when they were added
        source = Path(page.file.abs_src_path).relative_to(ROOT).as_posix()
        markdown = with_site_links(markdown, source)
    markdown = _FENCE.sub(r'\1 title="\2"', markdown)
    if HELP in markdown:
        markdown = markdown.replace(HELP, _help_of_every_verb())
    if NAMES in markdown:
        markdown = markdown.replace(NAMES, _every_public_name())
    return markdown


def _help_of_every_verb() -> str:
    """One heading and one block for each verb, in the order of `evercal --help`."""
    from evercal import cli

    os.environ["COLUMNS"] = COLUMNS
    parts = []
    for group, verbs in cli.VERBS.items():
        parts.append(f"## {group}")
        for verb in verbs:
            shown = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
            with contextlib.redirect_stdout(shown):
                cli.main([verb, "--help"])
            shown.seek(0)
            parts.append(f"### evercal {verb}\n\n```text\n{shown.read().rstrip()}\n```")
    return "\n\n".join(parts)


def _every_public_name() -> str:
    """One directive of mkdocstrings for each public name."""
    import evercal

    defined = {name: getattr(evercal, name).__module__ for name in evercal._PUBLIC}
    return "\n\n".join(f"::: {module}.{name}" for name, module in defined.items())
