"""What pages say is so: cited code, imports and messages exist. Sentences are short."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from evercal.errors import with_options

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "evercal"
LONGEST = 40
"""Words of a sentence."""
GAP = "…"
"""Stands for a value, on the page of troubleshooting and in the texts of the source."""
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
}
ARCHITECTURE, PAPER, TROUBLESHOOTING = (
    PAGES[f"docs/{name}.md"] for name in ("architecture", "paper", "troubleshooting")
)
TREES = {
    path: ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")
}


def imports(tree: ast.AST) -> set[str]:
    """Modules that a file imports, lazy imports included."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {
                node.module,
                *(f"{node.module}.{alias.name}" for alias in node.names),
            }
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def test_arrows_of_the_architecture_are_imports() -> None:
    blocks = re.findall(r"^```imports\n(.*?)^```", ARCHITECTURE, re.M | re.S)
    arrows = re.findall(r"^([\w.]+) -> ([\w.]+)", "".join(blocks), re.M)
    assert len(arrows) > 30
    for source, target in arrows:
        files = []
        for module in (source, target):
            path = PACKAGE.joinpath(*module.split("."))
            files.append(
                path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
            )
        assert files[1] in TREES, target
        assert f"evercal.{target}" in imports(TREES[files[0]]), f"{source} -> {target}"


def test_architecture_describes_every_folder() -> None:
    folders = {
        path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()
    }
    assert folders <= set(re.findall(r"^\| `(\w+)`", ARCHITECTURE, re.M))


def defined_names(source: str) -> set[str]:
    """Functions, classes, their members, and module constants."""
    names: set[str] = set()

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(prefix + node.name)
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")
            targets = (
                node.targets
                if isinstance(node, ast.Assign)
                else [getattr(node, "target", 0)]
            )
            names.update(
                prefix + target.id for target in targets if isinstance(target, ast.Name)
            )

    visit(ast.parse(source).body, "")
    return names


def test_code_that_the_page_of_the_paper_cites_exists() -> None:
    cited = set(
        re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|md|jsonl))(?:::([\w.]+))?`", PAPER)
    )
    assert len(cited) > 50
    beside = ("tests", "docs", "benchmarks", "results", "rooms", "training", "research")
    for path, name in cited:
        file = (ROOT if path.split("/")[0] in beside else PACKAGE) / path
        assert file.is_file(), f"docs/paper.md cites {path}, which does not exist"
        assert not name or name in defined_names(file.read_text("utf-8")), (
            f"{path}::{name}"
        )
    names = defined_names(
        "A = 1\nB: int = 2\nclass C:\n    x: int = 0\n    def f(self): ...\n"
    )
    assert names == {"A", "B", "C", "C.x", "C.f"}


def test_page_of_the_paper_covers_every_equation_algorithm_table_and_figure() -> None:
    equations = {int(number) for number in re.findall(r"\| equation (\d+)", PAPER)}
    assert equations == set(range(1, 14))
    parts = ["Algorithm 1", "Algorithm 2", "Tables 1 and 2", "Table 3", "Table 4"]
    parts += ["Figures 1 and 2", "Figure 3", "Figures 4 to 6", "Figures 7 to 9"]
    assert all(f"| {part}" in PAPER for part in parts)


def test_links_of_the_page_of_the_paper_lead_to_headings() -> None:
    for path, anchor in re.findall(r"\]\(([\w/.-]+\.md)(#[\w-]+)?\)", PAPER):
        headings = re.findall(
            r"^#+ (.+)$", (ROOT / "docs" / path).read_text("utf-8"), re.M
        )
        slugs = {
            re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
            for heading in headings
        }
        assert not anchor or anchor[1:] in slugs, path + anchor


def texts(tree: ast.AST) -> set[str]:
    """Strings of a module; a gap stands for each value of an f-string."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [
                str(p.value) if isinstance(p, ast.Constant) else GAP
                for p in node.values
            ]
            found.add("".join(parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value)
    return found


def is_quote(message: str, text: str) -> bool:
    """Whether a message is a part of a text; a gap may stand for more than one value."""
    parts = [re.escape(part) for part in message.split(GAP)]
    return re.search(".*".join(parts), text) is not None


def test_messages_of_troubleshooting_are_in_the_source() -> None:
    quoted = re.findall(r"^\| `(.*?)` \| .*? \| .*? \|$", TROUBLESHOOTING, re.M)
    assert len(quoted) == len(set(quoted)) > 40
    source = {with_options(text) for tree in TREES.values() for text in texts(tree)}
    for message in quoted:
        assert len(re.sub(r"\W", "", message)) >= 8, (
            f"{message}: too short to identify a message"
        )
        assert any(is_quote(message, text) for text in source), message
    text = "scene …: the map has only …; give one"
    assert text in texts(
        ast.parse('f"scene {name!r}: the map has only" f" {names}; give one"')
    )
    assert is_quote("the map has only", text)
    assert not is_quote("scene …: the map lacks …", text)


def paragraphs(text: str) -> Iterator[str]:
    """Paragraphs and list items of a Markdown page, without code, tables and headings."""
    lines: list[str] = []
    in_code = False
    for line in [*text.splitlines(), ""]:
        in_code ^= line.startswith("```")
        item = line.startswith(("- ", "* "))
        skipped = in_code or line.startswith(("    ", "|", "#", "<!--", "```", "!["))
        if (skipped or item or not line.strip()) and lines:
            yield " ".join(lines)
            lines = []
        if not skipped and line.strip():
            lines.append(line.lstrip("-* ").strip())


def docstrings(tree: ast.AST) -> Iterator[str]:
    """Paragraphs of the docstrings of a module, attribute docstrings included."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
            continue
        if isinstance(node.value.value, str):
            yield from re.split(r"\n\s*\n", node.value.value)


def long_sentences(texts: Iterator[str]) -> list[str]:
    """Sentences of more words than allowed; code, links and lists of fields count little."""
    found = []
    for text in texts:
        plain = re.sub(r"`[^`]*`", "x", " ".join(text.split()))
        plain = re.sub(r"\]\([^)]*\)", "]", plain)
        sentences = re.split(r"(?<=[.!?;:])\s+", plain)
        found += [sentence for sentence in sentences if len(sentence.split()) > LONGEST]
    return found


def test_sentences_of_pages_docstrings_and_help_are_short() -> None:
    long = {page: long_sentences(paragraphs(text)) for page, text in PAGES.items()}
    long |= {
        str(path): long_sentences(docstrings(tree)) for path, tree in TREES.items()
    }
    assert {name: sentences for name, sentences in long.items() if sentences} == {}


def test_long_sentences_are_noticed() -> None:
    words = " ".join(["word"] * 41)
    assert long_sentences(iter([f"Short. {words}. Short."])) == [f"{words}."]
    assert long_sentences(
        paragraphs(f"# Title\n\n- {words}\n\n```\n{words}\n```\n")
    ) == [words]
    assert long_sentences(docstrings(ast.parse(f'def f():\n    """{words}"""\n'))) == [
        words
    ]
