"""Folders import only from folders above them; lazy and relative imports count.

So the product reaches nothing of the simulation or the networks, which stand below it. Only the
networks import torch.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import evercal
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import Recording, write_image
from evercal.recordings.formats import generic

ORDER = (
    "geometry",
    "storage",
    "robot",
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
FOR_ALL = (
    "bounds",
    "choices",
    "classes",
    "cluster",
    "errors",
    "processes",
    "progress",
    "typing",
)
FACES = ("__init__", "__main__")
"""Modules of the root that may import everything."""
PRODUCT = ORDER[: ORDER.index("simulation")]
MOST_LOCALIZING = 61
"""Modules of evercal that a program loads for localizing, at most."""
MOST_LEARNING = 100
"""The same for learning."""


def imported(
    tree: ast.AST, package: tuple[str, ...]
) -> Iterator[tuple[int, tuple[str, ...]]]:
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
            if name in ("import_module", "__import__") and isinstance(
                target, ast.Constant
            ):
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
        for line, parts in imported(
            ast.parse(file.read_text(encoding="utf-8")), package
        ):
            if parts[0] == "evercal" and not (set(parts[1:2]) & {*allowed, *FOR_ALL}):
                lines.append(f"{inside}:{line}: imports {'.'.join(parts)}")
    return lines


def circle(root: Path) -> list[str]:
    """A circle of imports between files, or between subfolders of a folder.

    For subfolders, each is one thing, and so is each file beside them. A package's `__init__`
    may import what is in it.
    """
    names = {
        ".".join(("evercal", *path.relative_to(root).with_suffix("").parts))
        for path in root.rglob("*.py")
    }
    files = dict[str, set[str]]()
    rooms = dict[str, set[str]]()
    for name in sorted(names):
        path = root.joinpath(*name.split(".")[1:]).with_suffix(".py")
        if path.stem in FACES:
            continue
        tree = ast.parse(path.read_text("utf-8"))
        for _, parts in imported(tree, tuple(name.split(".")[:-1])):
            longer = ".".join(parts)
            target = longer if longer in names else longer.rpartition(".")[0]
            if target in names:
                files.setdefault(name, set()).add(target)
            if target in names and name.split(".")[1] == target.split(".")[1]:
                pair = [".".join(module.split(".")[:3]) for module in (name, target)]
                if pair[0] != pair[1]:
                    rooms.setdefault(pair[0], set()).add(pair[1])
    for graph in (files, rooms):
        try:
            TopologicalSorter(graph).prepare()
        except CycleError as error:
            return error.args[1]
    return []


def torch_imports(root: Path) -> list[str]:
    """Modules outside `continual` that import torch, at any depth."""
    files = {
        file.relative_to(root).as_posix(): file for file in sorted(root.rglob("*.py"))
    }
    found = {
        name: imported(ast.parse(file.read_text("utf-8")), ())
        for name, file in files.items()
    }
    using = [
        name for name, of in found.items() if "torch" in {parts[0] for _, parts in of}
    ]
    return [name for name in using if not name.startswith("continual/")]


def outside_product(module: str) -> bool:
    """Whether a module belongs to the networks, their torch, the simulation or the command line."""
    return module.split(".")[0] == "torch" or not {*module.split(".")[1:2]} <= {
        *PRODUCT,
        *FOR_ALL,
    }


def test_folders_import_only_from_folders_above() -> None:
    lines = violations(Path(evercal.__file__).parent)
    assert not lines, "\n" + "\n".join(lines)


def test_no_imports_go_in_a_circle(tmp_path: Path) -> None:
    assert circle(Path(evercal.__file__).parent) == []
    for name, text in {
        "maps/plain.py": "from evercal.maps import one, other",
        "maps/one.py": "def f():\n    from evercal.maps.other import g",
        "maps/other.py": "import evercal.maps.one",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert {*circle(tmp_path)} == {"evercal.maps.one", "evercal.maps.other"}
    (tmp_path / "maps/other.py").write_text("from evercal.maps.deep.low import f")
    assert circle(tmp_path) == []
    (tmp_path / "maps/deep").mkdir()
    (tmp_path / "maps/deep/low.py").write_text("")
    (tmp_path / "maps/deep/high.py").write_text("from evercal.maps.plain import x")
    assert {*circle(tmp_path)} > {"evercal.maps.deep"}


def test_only_networks_import_torch(tmp_path: Path) -> None:
    assert torch_imports(Path(evercal.__file__).parent) == []
    (tmp_path / "continual").mkdir()
    for name in ("continual/head.py", "map.py", "plain.py"):
        (tmp_path / name).write_text("def f():\n    from torch.nn import functional\n")
    (tmp_path / "plain.py").write_text(
        "from evercal.continual import torch\nimport torchlike"
    )
    assert torch_imports(tmp_path) == ["map.py"]


def printed(code: str, *words: Path) -> list[list[str]]:
    """Words on each line that a program prints."""
    command = [sys.executable, "-c", code, *map(str, words)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=300
    )
    return [line.split() for line in done.stdout.splitlines()]


def loaded_modules(code: str, *words: Path) -> list[list[str]]:
    """Modules of evercal, and torch, that a program has loaded, each time that it calls `show`."""
    return printed(f"{SHOW}\n{code}\nshow()", *words)


SHOW = """
import sys, evercal
def show():
    print(*(name for name in sys.modules if name.split(".")[0] in ("evercal", "torch")))
"""
LEARN = """
map = evercal.Map.open(sys.argv[1])
map.learn(sys.argv[2], memory="40%")
"""
LOCALIZE_AND_CALIBRATE = """
map = evercal.Map.open(sys.argv[1])
assert map.localize(evercal.read_image(sys.argv[2])).status == "ok"
show()
calibration = map.calibrate(sys.argv[2])
map.check(sys.argv[2], calibration)
"""


def test_learning_loads_few_modules_and_only_the_product(
    rooms: tuple[Recording, ...], tmp_path: Path
) -> None:
    generic.write(tmp_path / "room", rooms[0])
    (modules,) = loaded_modules(LEARN, tmp_path / "map", tmp_path / "room")
    print(len(modules), "modules are loaded for learning")  # noqa: T201
    assert "evercal.mapping.build" in modules
    assert [name for name in modules if outside_product(name)] == []
    assert len(modules) <= MOST_LEARNING, "\n".join(modules)


def test_locating_and_calibrating_load_few_modules_and_only_the_product(
    hall_map: MapContents, hall: Recording, tmp_path: Path
) -> None:
    MapStore.create(tmp_path / "map").commit(hall_map.scenes[0], {})
    write_image(tmp_path / "image.png", hall.test[7].read_image())
    localizing, all_modules = loaded_modules(
        LOCALIZE_AND_CALIBRATE, tmp_path / "map", tmp_path / "image.png"
    )
    print(len(localizing), "modules are loaded for localizing")  # noqa: T201
    assert "evercal.localization.localizer" in localizing
    assert "evercal.calibration.from_images" in all_modules
    assert [name for name in all_modules if outside_product(name)] == []
    assert len(localizing) <= MOST_LOCALIZING, "\n".join(localizing)


def test_import_is_fast_and_provides_every_public_name() -> None:
    code = "import sys, time; began = time.perf_counter(); import evercal\n"
    code += "print(time.perf_counter() - began, *sys.modules)"
    ((seconds, *modules),) = printed(code)
    heavy = {
        "torch",
        "cv2",
        "scipy",
        "matplotlib",
        "pandas",
        "tyro",
        "numpy",
    }
    assert not heavy & set(modules)
    assert float(seconds) < 1.0
    for name in dir(evercal):
        assert getattr(evercal, name) is not None
    # What `help(evercal)` lists.
    listed = re.findall(r"^    (\w+)  ", evercal.__doc__ or "", re.M)
    assert sorted([*listed, "__version__"]) == dir(evercal)
    with pytest.raises(AttributeError, match="'evercal' has no attribute 'Localiser'"):
        _ = evercal.Localiser  # pyright: ignore[reportAttributeAccessIssue]


def test_geometry_and_recordings_load_no_torch_and_no_opencv() -> None:
    code = "import sys, evercal.geometry, evercal.storage, evercal.recordings; print(*sys.modules)"
    (modules,) = printed(code)
    assert not {"torch", "cv2"} & set(modules)


def test_the_product_does_without_pandas_and_matplotlib() -> None:
    # A module that cannot be imported stands for one that is not installed.
    code = """
import importlib, pathlib, pkgutil, sys
sys.modules |= dict.fromkeys(("matplotlib", "pandas"))
import evercal
for module in pkgutil.walk_packages(evercal.__path__, "evercal."):
    if module.name.split(".")[1] not in ("continual", "__main__"):
        importlib.import_module(module.name)
from evercal.recordings.poses.row_files import table_cells
from evercal.reports import charts, page
print(*table_cells(["a,b"])[0], page.environment().get_template("calibration.html").name)
"""
    assert printed(code) == [["a", "b", "calibration.html"]]


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
    for name, text in {**planted, **allowed}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert {line.split(":")[0] for line in violations(tmp_path)} == set(planted)
