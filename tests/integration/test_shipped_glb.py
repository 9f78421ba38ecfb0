"""The GLB of every shipped scene, its focal regions as parts with a textured material: Khronos' validator is silent.

Every day a third of the scenes, with parts of a coarse grid; `-m slow` all, with those of a grid as fine as a run's.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from viewer_setup import glb_faults, needs_validator

from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.export.solid.part_solid import part_solid
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.training.geometry_stage import GeometryStage

SCENES = sorted((Path(__file__).resolve().parents[2] / "scenes").glob("*/scene.xml"))


@needs_validator
@pytest.mark.parametrize(("resolution", "each"), [(24, 3), pytest.param(64, 1, marks=pytest.mark.slow)])
def test_shipped_scenes(resolution: int, each: int, tmp_path: Path) -> None:
    config = RunConfig.model_validate({"field": {"offsets": False}, "geometry": {"grid_resolution": resolution}})
    field = TextureField(seed=0)
    for path in SCENES[::each]:
        scene = load_edit_scene(path)
        stage = GeometryStage(scene, config, None)
        solids = {name: part_solid(stage.grown(), name) for name in scene.parts}
        parts = {name: PartAsset(scene.frame.to_user(s.vertices), s.faces, field) for name, s in solids.items()}
        assert all(len(solid.faces) > 100 for solid in solids.values()), path
        export_assets(scene, config, parts, tmp_path / path.parent.name, ["glb"], texture_size=64)
    files = sorted(tmp_path.glob("*/asset.glb"))
    assert len(files) == 15 // each
    assert glb_faults(*files) == {}
