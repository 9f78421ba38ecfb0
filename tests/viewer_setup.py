"""Programs of others that look at exports: where our scripts for them are, and what a test needs to run one."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

VIEWERS = Path(__file__).parents[1] / "tools" / "viewers"


def _without(program: str, module: str) -> bool:
    return shutil.which(program) is None or not (VIEWERS / "node_modules" / module).is_dir()


needs_validator = pytest.mark.skipif(
    _without("node", "gltf-validator"), reason="needs node, and npm install in tools/viewers"
)
needs_browser = pytest.mark.skipif(
    _without("chromium", "playwright-core"), reason="needs chromium, and npm install in tools/viewers"
)
_BLENDER_SCRIPT = str(VIEWERS / "blender_import.py")
BLENDER = (
    [os.environ["BPY_PYTHON"], _BLENDER_SCRIPT, "--"]
    if "BPY_PYTHON" in os.environ
    else ["blender", "-b", "--factory-startup", "--python-exit-code", "3", "-P", _BLENDER_SCRIPT, "--"]
)
"""Starts our script in Blender; its arguments follow."""
needs_blender = pytest.mark.skipif(
    shutil.which(BLENDER[0]) is None, reason="needs blender, or in BPY_PYTHON a Python that has bpy"
)


def glb_faults(*paths: Path) -> dict[str, Any]:
    """File -> what Khronos' validator says of it; only files with errors or warnings, so that nothing is all well."""
    command = ["node", str(VIEWERS / "validate_glb.mjs"), *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    reports = json.loads(done.stdout)
    assert len(reports) == len(paths), done.stderr
    return {name: report for name, report in reports.items() if report["errors"] or report["warnings"]}
