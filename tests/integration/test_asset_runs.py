"""Mesh files from the command line to an export: import, run, GLB."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from viewer_setup import VIEWERS, glb_faults

from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.cli.main import main
from fd_mitsuba.export.formats import METRES

ASSETS = Path(__file__).parents[1] / "data" / "assets"
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".3ds", ".dae")
NAMES = sorted(path.name for path in ASSETS.iterdir() if path.suffix in SUFFIXES)
FEW = ["figure.glb", "duck.stl"]
REST = [pytest.param(name, marks=pytest.mark.slow) for name in NAMES if name not in FEW]
SMALL = [
    "geometry.steps=2", "appearance.steps=2", "output.turntable_frames=2", "output.turntable_size=32",
    "output.texture_size=64", "output.faces=1000", "output.picture_size=0", "geometry.lambda_sds=0",
    "appearance.lambda_sds=0",
]  # fmt: skip


def run(*arguments: object) -> int:
    settings = [word for item in SMALL for word in ("--set", item)]
    return main(["run", *map(str, arguments), "-c", "smoke", *settings, "-q"])


@pytest.mark.parametrize("name", FEW + REST)
def test_a_mesh_file_is_edited_in_one_command(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "runs" / "mine"
    given = [ASSETS / name, "--prompt", "a thing with a hat", "--at", "top", "-o", folder]
    assert run(*given) == 0
    said = capfd.readouterr().err
    assert f"imported to {tmp_path / 'runs' / 'mine.scene' / 'scene.xml'}" in said and "top: its top" in said
    exported = read_asset(folder / "export" / "asset.glb")
    assert exported.meshes[-1].name == "part_part" and len(exported.meshes[-1].faces) > 50
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["base_identical"] and metrics["inside_fraction"] > 0.9
    before = read_asset(ASSETS / name)
    size = [np.ptp(np.concatenate([mesh.placed()[0] for mesh in meshes]), axis=0).max()
            for meshes in (before.meshes, exported.meshes[:-1])]  # fmt: skip
    assert np.isclose(size[0] * METRES[before.unit or "m"], size[1], rtol=1e-5)  # a GLB is in metres
    if (VIEWERS / "node_modules" / "gltf-validator").is_dir():
        assert not glb_faults(folder / "export" / "asset.glb")


def test_the_import_beside_a_run_is_used_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "mine"
    given = [ASSETS / "box.glb", "--prompt", "a box with a hat", "--stage", "geometry", "-o", folder]
    assert run(*given) == 0
    before = (tmp_path / "mine.scene" / "scene.xml").stat().st_mtime_ns
    capfd.readouterr()
    assert run(*given, "--resume") == 0  # of a finished run: there is nothing left to do
    assert "imported" not in capfd.readouterr().err
    assert (tmp_path / "mine.scene" / "scene.xml").stat().st_mtime_ns == before
    assert run(*given, "--at", "left side", "--resume") == 1  # regions of another kind: another scene
    assert "holds a run already, of another import" in capfd.readouterr().err
    assert (tmp_path / "mine.scene" / "scene.xml").stat().st_mtime_ns == before
