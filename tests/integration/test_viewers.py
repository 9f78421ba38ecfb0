"""Exports in programs of others: Blender and a browser. Slow, and skipped where these are not installed.

Blender is Debian's package with python3-numpy, whose missing `np.bool` blender_import.py puts back; the browser needs
chromium and `npm install` in tools/viewers.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_export_assets import Learned, exported, textured_base  # noqa: F401
from viewer_setup import BLENDER, VIEWERS, needs_blender, needs_browser

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.io.srgb import srgb_from_linear
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene

Make = Callable[..., Path]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.fixture
def export(make_scene: Make, textured_base: str, tmp_path: Path) -> tuple[EditScene, Path]:  # noqa: F811
    scene = load_edit_scene(make_scene(base=textured_base))
    exported(scene, tmp_path / "out", Learned, size=256)
    return scene, tmp_path / "out"


@needs_blender
@pytest.mark.parametrize("model", ["asset.glb", "obj/asset.obj"])
def test_blender(export: tuple[EditScene, Path], model: str, tmp_path: Path, mi: Any) -> None:
    scene, folder = export
    output = tmp_path / "blender"
    arguments = [str(folder / model), str(folder / "mitsuba" / "scene.xml"), str(output), "8"]
    done = subprocess.run([*BLENDER, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    line = next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))
    found = json.loads(line.removeprefix("FOUND "))
    assert set(found) == {"base", "part_part"}
    low, high = scene.base[0].vertices.min(axis=0), scene.base[0].vertices.max(axis=0)
    # Blender has z upwards: (x, y, z) becomes (x, -z, y).
    assert np.allclose(found["base"]["low"], [low[0], -high[2], low[1]], atol=1e-5)
    assert np.allclose(found["base"]["high"], [high[0], -low[2], high[1]], atol=1e-5)
    (material,) = found["part_part"]["materials"].values()
    assert {"Base Color", "Roughness", "Metallic", "Normal"} <= set(material["linked"])
    (paint,) = found["base"]["materials"].values()
    assert [size[:2] for size in paint["images"].values()] == [[64, 32]]
    with file_threads():
        pixels = np.array(mi.Bitmap(f"{output}_unlit.exr"))
        loaded = mi.load_file(str(folder / "mitsuba" / "scene.xml"), parallel=False)
    film = mi.traverse(loaded.sensors()[0])
    film["film.size"] = [256, 256]
    film.update()
    albedo = np.array(mi.render(loaded, integrator=mi.load_dict({"type": "aov", "aovs": "a:albedo"}), spp=16))
    inside = (pixels[..., 3] > 0.999) & (albedo.sum(axis=-1) > 0)
    assert inside.mean() > 0.05
    difference = np.abs(srgb_from_linear(pixels[..., :3]) - srgb_from_linear(albedo))[inside]
    assert difference.mean() < 3 / 255


@needs_browser
def test_browser(export: tuple[EditScene, Path], tmp_path: Path) -> None:
    picture = tmp_path / "browser.png"
    command = ["node", str(VIEWERS / "screenshot_glb.mjs"), str(export[1] / "asset.glb"), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout)["materials"] == ["ball", "part_part"]
    pixels = np.asarray(Image.open(picture).convert("RGBA"))
    assert (pixels[..., 3] > 0).mean() > 0.05 and pixels[..., :3].std() > 20
