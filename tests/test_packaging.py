"""What must travel with the package does."""

import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_a_wheel_holds_the_tables_of_the_benchmark(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed")
    from hatchling.builders.wheel import WheelBuilder  # pyright: ignore[reportMissingImports]

    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    source = ROOT / "src"
    tables = sorted((source / "evercal" / "benchmark" / "row_files").glob("*.json"))
    assert len(tables) >= 3
    for path in tables:
        assert path.relative_to(source).as_posix() in held
