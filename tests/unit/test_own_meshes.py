"""Pictures that compare before and after show the base's own triangles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh
from conftest import write_ply

from fd_mitsuba.config import GeometryConfig, OutputConfig, RunConfig
from fd_mitsuba.export.final_surface.final_part import final_parts
from fd_mitsuba.export.solid.part_solid import part_solid
from fd_mitsuba.runs.geometry_outcome import export_geometry
from fd_mitsuba.runs.own_meshes import base_mesh, creased, edited_mesh, start_mesh
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.viewing.turntable import render_ring

Make = Callable[..., Path]
CONFIG = RunConfig(
    geometry=GeometryConfig(grid_resolution=24, steps=2), output=OutputConfig(turntable_size=64, turntable_frames=2)
)


def same_corners(found: tuple[torch.Tensor, torch.Tensor], vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the triangles are the same, in the same order, each from the same corner on."""
    return np.allclose(found[0].numpy()[found[1].numpy()], vertices[faces], atol=1e-6)


def test_the_base_is_its_own_mesh(make_scene: Make) -> None:
    scene = load_edit_scene(make_scene())
    base = scene.base_canonical
    assert same_corners(base_mesh(scene), base.vertices, base.faces)
    start = start_mesh(scene)
    assert same_corners((start[0], start[1][: len(base.faces)]), base.vertices, base.faces)
    assert len(start[1]) == len(base.faces) + len(scene.regions[0].surface(4).faces)


def test_a_whisker_is_in_the_pictures(make_scene: Make, tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]) -> None:
    """A rod a tenth of a grid cell thick is lost by the grid, which must not show as if the edit had removed it."""
    rod = trimesh.creation.cylinder(0.004, 0.8)
    path = make_scene()
    vertices = np.concatenate([animal[0], rod.vertices + [0, 0.1, -0.5]])
    write_ply(tmp_path / "animal.ply", vertices, np.concatenate([animal[1], rod.faces + len(animal[0])]))
    scene = load_edit_scene(path)
    stage = GeometryStage(scene, CONFIG, None)
    own = render_ring(base_mesh(scene), 4, 192, stage.aim)
    grid = render_ring((stage.base_surface.vertices, stage.base_surface.faces), 4, 192, stage.aim)
    plain = trimesh.Trimesh(scene.base_canonical.vertices, scene.base_canonical.faces, process=False)
    rings = render_ring((torch.tensor(plain.vertices).float(), torch.tensor(plain.faces)), 4, 192, stage.aim)
    covered = [(pictures.max(axis=3) > 0) for pictures in (own, grid, rings)]
    assert (covered[0] ^ covered[2]).sum() == 0
    assert (covered[0] & ~covered[1]).sum() > 100


def test_away_from_the_part_before_and_after_are_equal(make_scene: Make) -> None:
    """To the last bit, in normals and outline: nothing there may look as if it had changed."""
    scene = load_edit_scene(make_scene())
    stage = GeometryStage(scene, CONFIG, None)
    part = part_solid(stage.grown(), None)
    before = render_ring(base_mesh(scene), 6, 96, stage.aim)
    after = render_ring(edited_mesh(scene, part, None), 6, 96, stage.aim)
    alone = render_ring((torch.from_numpy(part.vertices).float(), torch.from_numpy(part.faces)), 6, 96, stage.aim)
    away = alone.max(axis=3) == 0
    np.testing.assert_array_equal(before[away], after[away])
    assert (before[~away] != after[~away]).any() and away.mean() > 0.8


def test_inward_faces_are_shown_outwards(
    make_scene: Make, tmp_path: Path, animal: tuple[np.ndarray, np.ndarray]
) -> None:
    path = make_scene()
    right = render_ring(base_mesh(load_edit_scene(path)), 2, 64, np.zeros(3))
    write_ply(tmp_path / "animal.ply", animal[0], animal[1][:, ::-1])
    turned = render_ring(base_mesh(load_edit_scene(path)), 2, 64, np.zeros(3))
    assert np.abs(right.astype(int) - turned).mean() < 0.5


def test_edges_stay_sharp_and_curves_smooth() -> None:
    cube = trimesh.creation.box()
    vertices, faces = creased(cube.vertices, cube.faces)
    assert len(vertices) == 24 and np.allclose(vertices[faces], cube.vertices[cube.faces])
    ball, triangles = unit_sphere(2)
    split = ball[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3)  # a seam at every edge
    vertices, faces = creased(*split)
    assert len(vertices) == len(ball) and np.allclose(vertices[faces], ball[triangles])


def test_a_run_shows_them(make_scene: Make, tmp_path: Path) -> None:
    """The first row of the sheet of a run is the base's own mesh."""
    from PIL import Image

    scene = load_edit_scene(make_scene())
    stage = GeometryStage(scene, CONFIG, None)
    export_geometry(stage, tmp_path / "run", final_parts(stage.grown(), CONFIG.output.faces))
    sheet = np.asarray(Image.open(tmp_path / "run" / "images" / "turntable.png").convert("RGB"))
    row = np.concatenate(list(render_ring(base_mesh(scene), 8, 64, stage.aim)), axis=1)
    np.testing.assert_array_equal(sheet[18 : 18 + 64, : 8 * 64], row)
