"""What is installed: every package in the source tree, by the names that setup.cfg gives."""

from __future__ import annotations

import configparser
from pathlib import Path

ROOT = Path(__file__).parent.parent
SETUP = configparser.ConfigParser()
SETUP.read(ROOT / "setup.cfg")


def packages_under(root: Path, top: str) -> set[str]:
    return {".".join(file.parent.relative_to(root).parts) for file in (root / top).rglob("__init__.py")}


def test_every_package_of_the_source_tree_is_installed() -> None:
    in_tree = packages_under(ROOT, "sb3_mpc_policy") | packages_under(ROOT / "envs", "contact_envs")
    listed = set(SETUP["options"]["packages"].split())
    assert listed == in_tree


def test_every_data_file_beside_the_sources_is_installed() -> None:
    roots = {"sb3_mpc_policy": ROOT / "sb3_mpc_policy", "contact_envs": ROOT / "envs" / "contact_envs"}
    for package, root in roots.items():
        patterns = SETUP["options.package_data"].get(package, "").split()
        names = (file.relative_to(root) for file in root.rglob("*") if file.is_file())
        for name in names:
            left_by_tools = any(part == "__pycache__" or part.startswith(".") for part in name.parts)
            if name.suffix != ".py" and not left_by_tools:
                assert any(name.match(pattern) for pattern in patterns), f"{package}: {name} is not in setup.cfg"
