"""The page that leads from the paper to the code: everything that it cites exists."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "paper.md").read_text()
CITED = sorted(set(re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|md|jsonl))(?:::([\w.]+))?`", PAGE)))


def defined_names(source: str) -> set[str]:
    """Functions, classes, their members, and module constants."""
    names: set[str] = set()

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", 0)]
            names.update(prefix + target.id for target in targets if isinstance(target, ast.Name))

    visit(ast.parse(source).body, "")
    return names


@pytest.mark.parametrize(("path", "name"), CITED, ids=["::".join(cited) for cited in CITED])
def test_cited_code_exists(path: str, name: str) -> None:
    outside = path.split("/")[0] in (
        "tests", "docs", "benchmarks", "results", "rooms", "training", "research"
    )  # fmt: skip
    file = ROOT / path if outside else ROOT / "src" / "evercal" / path
    assert file.is_file(), f"docs/paper.md cites {path}, which does not exist"
    if name:
        assert name in defined_names(file.read_text()), f"{path} defines no {name}"


def test_page_covers_every_equation_algorithm_table_and_figure() -> None:
    equations = {int(number) for number in re.findall(r"\| equation (\d+)", PAGE)}
    assert equations == set(range(1, 14))
    parts = ["Algorithm 1", "Algorithm 2", "Tables 1 and 2", "Table 3", "Table 4"]
    parts += ["Figures 1 and 2", "Figure 3", "Figures 4 to 6", "Figures 7 to 9"]
    assert all(f"| {part}" in PAGE for part in parts)
    assert len(CITED) > 50


def test_missing_names_are_detected() -> None:
    names = defined_names("A = 1\nB: int = 2\nclass C:\n    x: int = 0\n    def f(self): ...\n")
    assert names == {"A", "B", "C", "C.x", "C.f"}


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\(([\w/.-]+\.md)(#[\w-]+)?\)", PAGE))))
def test_links_lead_to_headings(link: tuple[str, str]) -> None:
    path, anchor = link
    text = (ROOT / "docs" / path).read_text()
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    slugs = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
    assert not anchor or anchor[1:] in slugs
