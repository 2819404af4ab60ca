"""A folder imports only from folders above it; lazy and relative imports count."""

import ast
from collections.abc import Iterator
from pathlib import Path

import evercal

ORDER = (
    "geometry",
    "drawing",
    "storage",
    "datasets",
    "simulation",
    "models",
    "training",
    "pretraining",
    "continual",
    "localization",
    "calibration",
    "evaluation",
    "viewer",
    "cli",
)
FOR_ALL = ("errors",)


def imported(tree: ast.AST, package: tuple[str, ...]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """(line, dotted parts) of everything a module in `package` imports, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, tuple(alias.name.split("."))
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else ()
            module = (*start, *(node.module.split(".") if node.module else ()))
            for alias in node.names:
                yield node.lineno, (*module, alias.name)
        elif isinstance(node, ast.Call) and node.args:
            # importlib.import_module("evercal.x") and __import__("evercal.x")
            name = getattr(node.func, "attr", getattr(node.func, "id", None))
            target = node.args[0]
            if name in ("import_module", "__import__") and isinstance(target, ast.Constant):
                yield node.lineno, tuple(str(target.value).split("."))


def violations(root: Path) -> list[str]:
    """One line per import that goes down or to a place outside the order."""
    found = []
    for file in sorted(root.rglob("*.py")):
        inside = file.relative_to(root)
        if len(inside.parts) == 1:
            # errors.py may be imported by all, so it imports none; the others are the public face.
            if inside.stem in ("__init__", "__main__"):
                continue
            allowed: tuple[str, ...] = ()
        elif inside.parts[0] not in ORDER:
            found.append(f"{inside}: folder {inside.parts[0]} has no place in the order")
            continue
        else:
            allowed = ORDER[: ORDER.index(inside.parts[0]) + 1]
        package = ("evercal", *inside.parent.parts)
        for line, parts in imported(ast.parse(file.read_text(encoding="utf-8")), package):
            if parts[0] == "evercal" and not (set(parts[1:2]) & {*allowed, *FOR_ALL}):
                found.append(f"{inside}:{line}: imports {'.'.join(parts)}")
    return found


def test_folders_import_only_from_folders_above() -> None:
    found = violations(Path(evercal.__file__).parent)
    assert not found, "\n" + "\n".join(found)


def test_planted_violations_are_found(tmp_path: Path) -> None:
    plants = {
        "geometry/plain.py": "import evercal.networks.head",
        "geometry/from_package.py": "from evercal import models",
        "geometry/root.py": "import evercal",
        "storage/lazy.py": "def f():\n    from evercal.datasets import load_scene",
        "datasets/relative.py": "from ..models import head",
        "datasets/bare_relative.py": "from .. import cli",
        "datasets/deep/relative.py": "from ...training import fit",
        "models/typed.py": "import typing\nif typing.TYPE_CHECKING:\n    import evercal.cli",
        "models/dynamic.py": "import importlib\nimportlib.import_module('evercal.cli')",
        "utils/any.py": "",
        "errors.py": "from evercal.geometry import SE3",
    }
    harmless = {
        "__init__.py": "from evercal.cli import main",
        "__main__.py": "from evercal.cli import main",
        "geometry/__init__.py": "from evercal.geometry.se3 import SE3\nimport numpy",
        "geometry/se3.py": "from evercal.errors import InputError\nfrom . import camera",
        "geometry/camera.py": "from ..errors import InputError",
        "cli/__init__.py": "from evercal.geometry import SE3\nfrom ..models import head",
        "models/deep/head.py": "from .. import other\nfrom ...geometry import SE3",
        "models/other.py": "import evercallike.cli",
    }
    for name, text in {**plants, **harmless}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = {line.split(":")[0] for line in violations(tmp_path)}
    assert found == set(plants)
