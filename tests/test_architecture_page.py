"""The drawings of docs/architecture.md are imports of the code."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evercal"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
ARROWS = [
    (source, target)
    for block in re.findall(r"^```imports\n(.*?)^```", PAGE, re.M | re.S)
    for source, target in re.findall(r"^([\w.]+) -> ([\w.]+)", block, re.M)
]


def file_of(module: str) -> Path:
    path = PACKAGE.joinpath(*module.split("."))
    return path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"


def imports(path: Path) -> set[str]:
    """Modules that a file imports, lazy imports included."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def test_there_are_drawings() -> None:
    assert len(ARROWS) > 30


@pytest.mark.parametrize(("source", "target"), ARROWS)
def test_arrow_is_an_import(source: str, target: str) -> None:
    assert file_of(target).exists()
    assert f"evercal.{target}" in imports(file_of(source))


def test_every_folder_is_described() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert folders <= set(re.findall(r"^\| `(\w+)`", PAGE, re.M))
