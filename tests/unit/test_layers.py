"""Data flows one way: a module imports only from its own layer or from the layers above it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import fd_mitsuba

ROOT = Path(fd_mitsuba.__file__).parent
LAYERS = (
    "conventions errors config_sections config mitsuba_api threads scene fields extraction render guidance losses "
    "training export evaluation prior cost check preview doctor geometry appearance pipeline parts cli_options "
    "batch_job batch_record batch_ray batch cli_batch cli_report evaluate evaluate_many ablation ablation_table "
    "cli_evaluate cli_ablate cli_export cli_prior cli __main__"
).split()
MODULES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def imported_layers(path: Path) -> set[str]:
    """First name below `fd_mitsuba` of every import in the file, those inside functions included."""
    package = ("fd_mitsuba", *path.relative_to(ROOT).with_suffix("").parts)
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin = ".".join(filter(None, [*package[: -node.level], node.module])) if node.level else node.module or ""
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    parts = [name.split(".") for name in names]
    return {part[1] for part in parts if part[0] == "fd_mitsuba" and len(part) > 1 and part[1] != "__version__"}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_only_from_layers_above(path: Path) -> None:
    own = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert own in LAYERS, f"{own} is in no layer; add it to LAYERS here and to the architecture"
    below = {name for name in imported_layers(path) if LAYERS.index(name) > LAYERS.index(own)}
    assert not below, f"{path.relative_to(ROOT)} imports from below: {sorted(below)}"
