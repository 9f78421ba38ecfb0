"""The GLB of every shipped scene, its focal regions as parts with a textured material: Khronos' validator is silent."""

from __future__ import annotations

from pathlib import Path

import pytest
from viewer_setup import glb_faults, needs_validator

from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.export.part_solid import part_solid
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.scene.edit_scene import load_edit_scene
from fd_mitsuba.training.geometry_stage import GeometryStage

ROOT = Path(__file__).resolve().parents[2]
QUICK = ("mug", "stump_butterfly")
"""The smallest two, for every day; the others are slow."""
SCENES = [
    pytest.param(path, marks=[] if path.parent.name in QUICK else pytest.mark.slow, id=path.parent.name)
    for path in sorted((ROOT / "scenes").glob("*/scene.xml"))
]


@needs_validator
@pytest.mark.parametrize("path", SCENES)
def test_shipped_scene(path: Path, tmp_path: Path) -> None:
    scene = load_edit_scene(path)
    settings = {"field": {"offsets": False}, "geometry": {"grid_resolution": 40}}
    config = RunConfig.model_validate(settings)
    stage, field = GeometryStage(scene, config, None), TextureField(seed=0)
    parts = {}
    for name in scene.parts:
        solid = part_solid(stage, name)
        parts[name] = PartAsset(scene.frame.to_user(solid.vertices), solid.faces, field)
    export_assets(scene, config, parts, tmp_path, ["glb"], texture_size=64)
    assert glb_faults(tmp_path / "asset.glb") == {}
