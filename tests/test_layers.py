"""Folders import only from folders above them; lazy and relative imports count.

Two more rules hold, also through other modules: finding a camera needs nothing that learns, and a
map needs nothing of the networks but the head that a store may hold.
"""

import ast
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import evercal

ORDER = (
    "geometry",
    "storage",
    "recordings",
    "features",
    "mapping",
    "localization",
    "calibration",
    "evaluation",
    "reports",
    "simulation",
    "continual",
    "cli",
)
FOR_ALL = ("errors",)
HEAD = "evercal.continual.networks.head"


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


def import_graph(root: Path) -> dict[str, set[str]]:
    """By module, those of ours that it loads, at any depth and with the packages they stand in."""
    names = {}
    for file in root.rglob("*.py"):
        inside = file.relative_to(root).with_suffix("")
        parts = inside.parts[:-1] if inside.name == "__init__" else inside.parts
        names[".".join(("evercal", *parts))] = file
    graph: dict[str, set[str]] = {}
    for name, file in names.items():
        package = name if file.stem == "__init__" else name.rpartition(".")[0]
        loaded = set()
        # The public face loads a name on first use; who imports it is not charged with all of them.
        found = [] if name == "evercal" else imported(ast.parse(file.read_text()), _parts(package))
        for _, target in found:
            loaded |= {p for i in range(len(target)) if (p := ".".join(target[: i + 1])) in names}
        graph[name] = loaded - {name}
    return graph


def _parts(name: str) -> tuple[str, ...]:
    return tuple(name.split("."))


def chains(
    graph: dict[str, set[str]], folder: str, forbidden: Callable[[str], bool]
) -> dict[str, list[str]]:
    """By forbidden module that a folder reaches: one chain of imports that leads to it."""
    start = [name for name in graph if name.startswith(f"evercal.{folder}")]
    chain = {name: [name] for name in start}
    queue = list(start)
    for name in queue:
        for target in sorted(graph[name] - chain.keys()):
            chain[target] = [*chain[name], target]
            queue.append(target)
    return {name: steps for name, steps in chain.items() if forbidden(name)}


def learns(module: str) -> bool:
    """Whether a module is there to learn, which finding a camera must not need."""
    in_networks = module.startswith("evercal.continual.networks.") and module != HEAD
    return module.startswith("evercal.continual") or in_networks


def fits_networks(module: str) -> bool:
    """Whether a module is of the networks and not the head."""
    return module.startswith("evercal.continual.networks.") and module != HEAD


def test_folders_import_only_from_folders_above() -> None:
    found = violations(Path(evercal.__file__).parent)
    assert not found, "\n" + "\n".join(found)


def test_localization_reaches_nothing_that_learns() -> None:
    graph = import_graph(Path(evercal.__file__).parent)
    found = chains(graph, "localization", learns)
    assert not found, "\n" + "\n".join(" -> ".join(steps) for steps in found.values())


def test_mapping_reaches_nothing_of_the_networks_but_the_head() -> None:
    graph = import_graph(Path(evercal.__file__).parent)
    found = chains(graph, "mapping", fits_networks)
    assert not found, "\n" + "\n".join(" -> ".join(steps) for steps in found.values())


def test_the_localizer_loads_nothing_that_learns() -> None:
    code = "import sys, evercal.localization.localizer, evercal.mapping.store; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    loaded = done.stdout.split()
    assert "evercal.mapping.store" in loaded
    assert [name for name in loaded if learns(name)] == []


def plant(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def test_planted_violations_are_found(tmp_path: Path) -> None:
    plants = {
        "geometry/plain.py": "import evercal.features.encoder",
        "geometry/from_package.py": "from evercal import features",
        "geometry/root.py": "import evercal",
        "storage/lazy.py": "def f():\n    from evercal.recordings import load_recording",
        "datasets/relative.py": "from ..features import encoder",
        "datasets/bare_relative.py": "from .. import cli",
        "datasets/deep/relative.py": "from ...networks import trainer",
        "features/typed.py": "import typing\nif typing.TYPE_CHECKING:\n    import evercal.cli",
        "features/dynamic.py": "import importlib\nimportlib.import_module('evercal.cli')",
        "localization/lazy.py": "def f():\n    from evercal.continual import learn",
        "mapping/localize.py": "from evercal.localization import localizer",
        "utils/any.py": "",
        "errors.py": "from evercal.geometry import SE3",
    }
    harmless = {
        "__init__.py": "from evercal.cli import main",
        "__main__.py": "from evercal.cli import main",
        "geometry/__init__.py": "from evercal.geometry.se3 import SE3\nimport numpy",
        "geometry/se3.py": "from evercal.errors import InputError\nfrom . import camera",
        "geometry/camera.py": "from ..errors import InputError",
        "cli/__init__.py": "from evercal.geometry import SE3\nfrom ..features import encoder",
        "features/deep/encoder.py": "from .. import other\nfrom ...geometry import SE3",
        "features/other.py": "import evercallike.cli",
    }
    plant(tmp_path, {**plants, **harmless})
    found = {line.split(":")[0] for line in violations(tmp_path)}
    assert found == set(plants)


def test_planted_ways_to_what_learns_are_found(tmp_path: Path) -> None:
    plant(
        tmp_path,
        {
            "__init__.py": "from evercal.continual.learn import learn",
            "networks/__init__.py": "",
            "networks/head.py": "import torch",
            "networks/trainer.py": "from evercal.continual.networks.head import Head",
            "networks/loss.py": "",
            "features/__init__.py": "",
            "features/innocent.py": "def f():\n    from evercal.continual.networks import loss",
            "mapping/__init__.py": "",
            "mapping/good.py": "from evercal.continual.networks.head import Head\nimport evercal.errors",
            "mapping/direct.py": "from evercal.continual.networks import trainer",
            "mapping/far.py": "from evercal.mapping import near",
            "mapping/near.py": "from ..features import innocent",
            "localization/__init__.py": "",
            "localization/localizer.py": "from evercal.mapping.good import Good",
            "localization/acceptance.py": "import evercal.continual.learn",
            "continual/__init__.py": "",
            "continual/learn.py": "",
        },
    )
    graph = import_graph(tmp_path)
    found = chains(graph, "mapping", fits_networks)
    assert found.keys() == {"evercal.continual.networks.trainer", "evercal.continual.networks.loss"}
    assert found["evercal.continual.networks.loss"][-2] == "evercal.features.innocent"
    assert chains(graph, "localization", learns).keys() == {
        "evercal.continual",
        "evercal.continual.learn",
    }
    del graph["evercal.localization.acceptance"]
    assert chains(graph, "localization", learns) == {}
