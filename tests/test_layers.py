"""Folders import only from folders above them; lazy and relative imports count.

The product reaches nothing of the networks or the simulation, also through other modules.
"""

import ast
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import evercal
from evercal.recordings import Recording, write_image
from evercal.recordings.formats import generic

ORDER = (
    "geometry",
    "storage",
    "recordings",
    "features",
    "mapping",
    "localization",
    "calibration",
    "live",
    "evaluation",
    "learning",
    "map",
    "reports",
    "service",
    "simulation",
    "continual",
    "cli",
)
"""Folders, and the module map.py."""
FOR_ALL = ("errors",)
FACES = ("__init__", "__main__")
"""Modules of the root that may import everything."""
PRODUCT = ORDER[: ORDER.index("simulation")]
MOST_LOCALIZING, MOST_LEARNING = 42, 62
"""Modules of evercal that a program loads, at most."""


def imported(tree: ast.AST, package: tuple[str, ...]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """(line, dotted parts) of everything that a module in `package` imports, at any depth."""
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
    """One line for each import of a lower or unknown folder."""
    lines = []
    for file in sorted(root.rglob("*.py")):
        inside = file.relative_to(root)
        in_root = len(inside.parts) == 1
        layer = inside.stem if in_root else inside.parts[0]
        if in_root and layer in FACES:
            continue
        if in_root and layer in FOR_ALL:
            allowed: tuple[str, ...] = ()
        elif layer in ORDER and in_root == (layer == "map"):
            allowed = ORDER[: ORDER.index(layer) + 1]
        else:
            lines.append(f"{inside}: {layer} is not in the order")
            continue
        package = ("evercal", *inside.parent.parts)
        for line, parts in imported(ast.parse(file.read_text(encoding="utf-8")), package):
            if parts[0] == "evercal" and not (set(parts[1:2]) & {*allowed, *FOR_ALL}):
                lines.append(f"{inside}:{line}: imports {'.'.join(parts)}")
    return lines


def import_graph(root: Path) -> dict[str, set[str]]:
    """By module, the modules of evercal that it imports, at any depth, with their packages."""
    files = {}
    for file in root.rglob("*.py"):
        inside = file.relative_to(root).with_suffix("")
        parts = inside.parts[:-1] if inside.name == "__init__" else inside.parts
        files[".".join(("evercal", *parts))] = file
    graph: dict[str, set[str]] = {}
    for name, file in files.items():
        package = name if file.stem == "__init__" else name.rpartition(".")[0]
        loaded = set()
        # `evercal` loads its names on first use, so a module that imports it does not load them.
        tree = ast.parse("" if name == "evercal" else file.read_text(encoding="utf-8"))
        for _, target in imported(tree, tuple(package.split("."))):
            prefixes = (".".join(target[: i + 1]) for i in range(len(target)))
            loaded |= {prefix for prefix in prefixes if prefix in files}
        graph[name] = loaded - {name}
    return graph


def chains(
    graph: dict[str, set[str]], layer: str, forbidden: Callable[[str], bool]
) -> dict[str, list[str]]:
    """By forbidden module that a layer reaches: one chain of imports that leads to it."""
    start = [name for name in graph if f"{name}.".startswith(f"evercal.{layer}.")]
    chain = {name: [name] for name in start}
    queue = list(start)
    for name in queue:
        for target in sorted(graph[name] - chain.keys()):
            chain[target] = [*chain[name], target]
            queue.append(target)
    return {name: steps for name, steps in chain.items() if forbidden(name)}


def outside_product(module: str) -> bool:
    """Whether a module belongs to the networks, the simulation or the command line."""
    return not {*module.split(".")[1:2]} <= {*PRODUCT, *FOR_ALL}


def test_folders_import_only_from_folders_above() -> None:
    lines = violations(Path(evercal.__file__).parent)
    assert not lines, "\n" + "\n".join(lines)


@pytest.mark.parametrize("layer", PRODUCT)
def test_product_reaches_no_networks_and_no_simulation(layer: str) -> None:
    reached = chains(import_graph(Path(evercal.__file__).parent), layer, outside_product)
    assert not reached, "\n" + "\n".join(" -> ".join(steps) for steps in reached.values())


def loaded_modules(code: str, *words: Path) -> list[str]:
    """Modules of evercal that a program has loaded at its end."""
    code = f"import sys\nfrom pathlib import Path\nimport evercal\n{code}\nprint(*sys.modules)"
    command = [sys.executable, "-c", code, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    return [name for name in done.stdout.split() if name.split(".")[0] == "evercal"]


LEARN = """
map = evercal.Map.open(sys.argv[1], device="cpu")
map.learn(sys.argv[2], memory="40%")
"""
LOCALIZE = """
map = evercal.Map.open(sys.argv[1], device="cpu")
assert map.localize(evercal.read_image(sys.argv[2])).status == "ok"
"""
CALIBRATE = """
map = evercal.Map.open(sys.argv[1], device="cpu")
calibration = map.calibrate(sys.argv[2])
map.check(sys.argv[2], calibration)
"""


@pytest.fixture(scope="module")
def learned(
    arcs: tuple[Recording, Recording], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path, list[str]]:
    """A map that a program has learned, an image of its scene, and the modules of the program."""
    root = tmp_path_factory.mktemp("layers")
    generic.write(root / "one", arcs[0])
    write_image(root / "image.png", np.asarray(arcs[0].test[12].read_image()))
    return root / "map", root / "image.png", loaded_modules(LEARN, root / "map", root / "one")


def test_learning_loads_few_modules_and_only_the_product(
    learned: tuple[Path, Path, list[str]],
) -> None:
    modules = learned[2]
    print(len(modules), "modules are loaded for learning")  # noqa: T201
    assert "evercal.mapping.build" in modules
    assert [name for name in modules if outside_product(name)] == []
    assert len(modules) <= MOST_LEARNING, "\n".join(modules)


def test_localizing_loads_few_modules_and_only_the_product(
    learned: tuple[Path, Path, list[str]],
) -> None:
    modules = loaded_modules(LOCALIZE, *learned[:2])
    print(len(modules), "modules are loaded for localizing")  # noqa: T201
    assert "evercal.localization.localizer" in modules
    assert [name for name in modules if outside_product(name)] == []
    assert len(modules) <= MOST_LOCALIZING, "\n".join(modules)


def test_calibrating_loads_only_the_product(learned: tuple[Path, Path, list[str]]) -> None:
    modules = loaded_modules(CALIBRATE, *learned[:2])
    assert "evercal.calibration.from_images" in modules
    assert [name for name in modules if outside_product(name)] == []


def plant(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def test_planted_violations_are_found(tmp_path: Path) -> None:
    planted = {
        "geometry/plain.py": "import evercal.features.encoder",
        "geometry/from_package.py": "from evercal import features",
        "geometry/root.py": "import evercal",
        "storage/lazy.py": "def f():\n    from evercal.recordings import load_recording",
        "recordings/relative.py": "from ..features import encoder",
        "recordings/bare_relative.py": "from .. import cli",
        "recordings/deep/relative.py": "from ...mapping import build",
        "features/typed.py": "import typing\nif typing.TYPE_CHECKING:\n    import evercal.cli",
        "features/dynamic.py": "import importlib\nimportlib.import_module('evercal.cli')",
        "calibration/lazy.py": "def f():\n    from evercal.map import Map",
        "localization/lazy.py": "def f():\n    from evercal.continual import learn",
        "mapping/localize.py": "from evercal.localization import localizer",
        "simulation/networks.py": "from evercal.continual import learn",
        "map.py": "from evercal.reports import page",
        "map/folder.py": "",
        "utils/any.py": "",
        "other.py": "",
        "geometry.py": "",
        "errors.py": "from evercal.geometry import SE3",
    }
    allowed = {
        "__init__.py": "from evercal.cli import main",
        "__main__.py": "from evercal.cli import main",
        "geometry/__init__.py": "from evercal.geometry.se3 import SE3\nimport numpy",
        "geometry/se3.py": "from evercal.errors import InputError\nfrom . import camera",
        "geometry/camera.py": "from ..errors import InputError",
        "cli/__init__.py": "from evercal.geometry import SE3\nfrom ..features import encoder",
        "reports/page.py": "from evercal.map import LearnReport",
        "features/deep/encoder.py": "from .. import other\nfrom ...geometry import SE3",
        "features/other.py": "import evercallike.cli",
    }
    plant(tmp_path, {**planted, **allowed})
    assert {line.split(":")[0] for line in violations(tmp_path)} == set(planted)


def test_planted_chains_are_found(tmp_path: Path) -> None:
    plant(
        tmp_path,
        {
            "__init__.py": "from evercal.continual.learning.learn import learn",
            "errors.py": "",
            "map.py": "from evercal.mapping.near import build",
            "features/__init__.py": "",
            "features/harmless.py": "def f():\n    from evercal.continual.networks import loss",
            "mapping/__init__.py": "",
            "mapping/good.py": "import evercal.errors",
            "mapping/direct.py": "from evercal.simulation import rooms",
            "mapping/far.py": "from evercal.mapping import near",
            "mapping/near.py": "from ..features import harmless",
            "localization/__init__.py": "",
            "localization/localizer.py": "from evercal.mapping.good import Good",
            "simulation/__init__.py": "",
            "simulation/rooms.py": "",
            "continual/__init__.py": "",
            "continual/learning/learn.py": "",
            "continual/networks/__init__.py": "",
            "continual/networks/loss.py": "",
        },
    )
    graph = import_graph(tmp_path)
    loss = "evercal.continual.networks.loss"
    networks = {"evercal.continual", "evercal.continual.networks", loss}
    simulation = {"evercal.simulation", "evercal.simulation.rooms"}
    assert chains(graph, "map", outside_product).keys() == networks
    reached = chains(graph, "mapping", outside_product)
    assert reached.keys() == networks | simulation
    assert reached[loss][-2] == "evercal.features.harmless"
    assert chains(graph, "localization", outside_product) == {}
