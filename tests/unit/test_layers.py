"""Data flows one way: a package imports only from those above it; within a package, imports have no cycle."""

from __future__ import annotations

import ast
import graphlib
from pathlib import Path

import pytest

import fd_mitsuba

ROOT = Path(fd_mitsuba.__file__).parent
LAYERS = (
    "conventions errors io config backend scene assets fields extraction render losses guidance viewing training "
    "export runs batch evaluation baselines prior api studio cli __main__"
).split()
"""Packages and modules of the root; batch stands above evaluation, because ablations and tables of many scenes run
through it."""
MOST_ROOT_MODULES = 6
MODULES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def imported_modules(path: Path) -> set[str]:
    """Dotted names of all that the file imports, inside functions too; of `from a import b` both `a` and `a.b`.

    What is imported for type checkers alone does not count.
    """
    package = ("fd_mitsuba", *path.relative_to(ROOT).with_suffix("").parts)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    names = set()
    for node in ast.walk(tree):
        if node in for_types:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin = ".".join(filter(None, [*package[: -node.level], node.module])) if node.level else node.module or ""
            names |= {origin} | {f"{origin}.{alias.name}" for alias in node.names}
    return names


def imported_layers(path: Path) -> set[str]:
    """First name below `fd_mitsuba` of every import in the file."""
    parts = [name.split(".") for name in imported_modules(path)]
    return {part[1] for part in parts if part[0] == "fd_mitsuba" and len(part) > 1 and part[1] != "__version__"}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_only_from_layers_above(path: Path) -> None:
    own = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert own in LAYERS, f"{own} is in no layer; add it to LAYERS here and to the architecture"
    below = {name for name in imported_layers(path) if LAYERS.index(name) > LAYERS.index(own)}
    assert not below, f"{path.relative_to(ROOT)} imports from below: {sorted(below)}"


def test_root_holds_few_modules() -> None:
    assert len(list(ROOT.glob("*.py"))) <= MOST_ROOT_MODULES


def test_modules_import_each_other_without_cycles() -> None:
    names = {
        path: ".".join(("fd_mitsuba", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        for path in MODULES
    }
    known = set(names.values())
    imports = {name: {other for other in imported_modules(path) if other in known} for path, name in names.items()}
    graphlib.TopologicalSorter(imports).prepare()  # CycleError names the modules
