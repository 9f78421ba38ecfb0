"""Part solids of every shipped scene, with the focal regions themselves as the part: manifold, touching, joinable."""

from __future__ import annotations

from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh

from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.final_surface.final_part import final_part
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.triangle_mesh import topology
from fd_mitsuba.training.geometry_stage import GeometryStage

SCENES = sorted((Path(__file__).resolve().parents[2] / "scenes").glob("*/scene.xml"))


@pytest.mark.slow
@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.parent.name)
def test_shipped_scene(path: Path) -> None:
    scene = load_edit_scene(path)
    stage = GeometryStage(scene, RunConfig.model_validate({"field": {"offsets": False}}), None)
    whole: manifold3d.Manifold | None = manifold3d.Manifold()
    for mesh in scene.base:
        source = manifold3d.Mesh(
            scene.frame.to_canonical(mesh.vertices).astype(np.float32), mesh.faces.astype(np.uint32)
        )
        source.merge()  # vertices are doubled along seams
        piece = manifold3d.Manifold(source)
        closed = topology(mesh.vertices, mesh.faces).closed
        assert (piece.status() == manifold3d.Error.NoError) == closed
        whole = whole + piece if closed and whole is not None else None
    for name in scene.parts:
        final = final_part(stage.grown(), name, 20_000)
        solid = final.solid
        assert np.percentile(smallest_angles(solid.vertices, solid.faces), 5) > 25
        assert final.distance.mean() < 0.02 * stage.grid.spacing
        mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
        assert solid.manifold and mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
        assert solid.gap(scene.base_canonical) == 0.0 and solid.islands_removed == 0
        part = solid.to_manifold()
        assert part.status() == manifold3d.Error.NoError
        if whole is None:  # an open base, as the stump is below, has no union
            continue
        joined, shared = whole + part, whole ^ part
        assert joined.status() == manifold3d.Error.NoError
        assert joined.volume() == pytest.approx(whole.volume() + part.volume() - shared.volume(), rel=1e-4)
        assert 0 < shared.volume() < 0.5 * part.volume()
