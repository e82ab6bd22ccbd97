"""The documentation: its code runs, its links lead somewhere, and it leaves nothing public out."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import contact_envs
import sb3_mpc_policy
from sb3_mpc_policy import identification
from tests.examples import examples_of, run_examples

ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "guides").glob("*.md")])
WITH_EXAMPLES = [page for page in PAGES if examples_of(page)]
LINKING = [*PAGES, *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md"))]
ARCHITECTURE = ROOT / "docs" / "architecture.md"


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def without_code(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def links_of(page: Path) -> Iterator[tuple[Path, str]]:
    """File and anchor of each link of a page into the repository."""
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page)):
        if not re.match(r"[a-z]+:", target):
            file, _, anchor = target.partition("#")
            yield (page.parent / file if file else page), anchor


def anchors_of(page: Path) -> set[str]:
    """What headings are linked by: lower case, without punctuation, hyphens for spaces."""
    headings = re.findall(r"^#+ (.*)$", without_code(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", WITH_EXAMPLES, ids=name_of)
def test_the_examples_of_a_page_run_and_print_what_it_says(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_examples(page)


def test_an_example_that_prints_something_else_than_its_page_says_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    text = "```python\nx = 1\n```\n\nWords.\n\n```python\nprint(x + {})\n```\n\n```text\n2\n```\n"
    page.write_text(text.format(1), encoding="utf-8")
    run_examples(page)
    page.write_text(text.format(2), encoding="utf-8")
    with pytest.raises(AssertionError, match=r"line 8: it prints\n3"):
        run_examples(page)


@pytest.mark.parametrize("page", LINKING, ids=name_of)
def test_the_links_of_a_page_lead_to_files_and_headings(page: Path) -> None:
    for file, anchor in links_of(page):
        assert file.exists(), f"{file} is linked to"
        assert not anchor or anchor in anchors_of(file), f"#{anchor} of {file.name} is linked to"


def test_some_links_are_found() -> None:
    assert (ROOT / "docs" / "guides" / "../how_it_works.md", "how-fast") in links_of(ROOT / "docs/guides/real_time.md")


def test_every_public_name_and_environment_stands_in_the_reference() -> None:
    reference = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    public = [f"sb3_mpc_policy.{name}" for name in sb3_mpc_policy.__all__]
    public += [f"sb3_mpc_policy.identification.{name}" for name in identification.__all__]
    public += [f"contact_envs.{name}" for name in contact_envs.__all__]
    environments = [f"`{env_id}`" for env_id in contact_envs.ENV_IDS]
    assert [name for name in public + environments if not re.search(rf"{re.escape(name)}(?!\w)", reference)] == []


# -- how it is built --


def named_in_tables(page: Path) -> set[str]:
    """The files in the first columns of a page's tables."""
    cells = re.findall(r"^\| (`.*?) \|", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {name for cell in cells for name in re.findall(r"`([\w/.]+\.\w+)`", cell)}


def test_every_file_of_both_packages_stands_in_the_layout() -> None:
    named = named_in_tables(ARCHITECTURE)
    for root in (ROOT / "sb3_mpc_policy", ROOT / "envs" / "contact_envs"):
        for file in root.rglob("*.py"):
            inside = file.relative_to(root).as_posix()
            is_empty_shell = file.name == "__init__.py" and file.parent != root
            assert is_empty_shell or inside in named or inside.removeprefix("solvers/") in named, inside


def test_every_file_in_the_layout_exists() -> None:
    roots = [ROOT / "sb3_mpc_policy", ROOT / "sb3_mpc_policy/solvers", ROOT / "envs/contact_envs", ROOT / "benchmarks"]
    assert [name for name in named_in_tables(ARCHITECTURE) if not any((root / name).exists() for root in roots)] == []


def imports_of(file: Path) -> set[str]:
    """The modules that a file imports when it is imported itself."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    return {node.module for node in tree.body if isinstance(node, ast.ImportFrom) and node.module} | {
        alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names
    }


def test_packages_are_imported_in_one_direction() -> None:
    for file in (ROOT / "envs").rglob("*.py"):
        assert not {name.partition(".")[0] for name in imports_of(file)} & {"sb3_mpc_policy", "benchmarks"}, file
    for file in (ROOT / "sb3_mpc_policy").rglob("*.py"):
        foreign = {name.partition(".")[0] for name in imports_of(file)} & {"contact_envs", "benchmarks"}
        assert foreign <= ({"contact_envs"} if file == ROOT / "sb3_mpc_policy/__init__.py" else set()), file


def test_layers_import_only_what_stands_above_them() -> None:
    block = re.search(r"^```text\n(lcp .*?)^```$", ARCHITECTURE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert block
    columns = [line[:38].split() for line in block[1].splitlines()]
    order = [name.rstrip("/") for line in columns for name in line]
    assert len(order) >= 15
    for name in order:
        path = ROOT / "sb3_mpc_policy" / name
        files = [path.with_suffix(".py")] if not path.is_dir() else sorted(path.glob("*.py"))
        for file in files:
            inner = {found.split(".")[1] for found in imports_of(file) if found.startswith("sb3_mpc_policy.")}
            assert inner <= set(order[: order.index(name) + 1]), f"{file.name} imports {inner}"
