"""Fewer faces for a solid: the budget is kept, the solid stays one, and what cannot be done is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import fast_simplification
import numpy as np
import pytest
import trimesh

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.final_surface.final_part import FinalPart
from fd_mitsuba.export.solid.decimation import decimated
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.runs import levels
from fd_mitsuba.runs.levels import checked_levels, largest_deviation, read_levels, remove_other_levels
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.vertex_normals import vertex_normals


def ball(scale: tuple[float, float, float] = (0.25, 0.25, 0.25), level: int = 4) -> Solid:
    mesh = trimesh.creation.icosphere(level)
    return Solid(mesh.vertices * scale, mesh.faces)


def leaves() -> Solid:
    """Two bent sheets, a hundredth as thick as they are wide: their sides come to touch when faces are few."""
    mesh = trimesh.creation.icosphere(5)
    points = mesh.vertices * (0.4, 0.004, 0.25)
    points[:, 1] += 0.6 * points[:, 0] ** 2
    other = points + (0.0, 0.3, 0.0)
    return Solid(np.concatenate([points, other]), np.concatenate([mesh.faces, mesh.faces + len(points)]))


CASES = [(ball, 2000), (ball, 600), (ball, 200), (ball, 100), (leaves, 1100), (leaves, 600)]


@pytest.mark.parametrize(("shape", "faces"), CASES)
def test_the_budget_is_kept_and_the_solid_stays_one(shape, faces: int) -> None:
    solid = shape()
    small = decimated(solid, faces)
    assert small.manifold and 0.7 * faces <= len(small.faces) <= faces
    away = MeshDistance(solid.vertices, solid.faces).unsigned(small.vertices)
    assert away.max() < 0.02 and small.pieces().max() == solid.pieces().max()
    assert small.volume == pytest.approx(solid.volume, rel=0.02 if faces >= 600 and shape is ball else 0.5)


def test_enough_is_left_as_it_is() -> None:
    solid = ball()
    assert decimated(solid, len(solid.faces)) is solid and decimated(solid, 10**6) is solid


def within_budget(name: str, solid: Solid, faces: int, say: Callable[[str], None]) -> Solid:
    normals = vertex_normals(solid.vertices, solid.faces)
    return levels.within_budget(name, FinalPart(solid, normals, np.zeros(len(solid.vertices))), faces, say).solid


def test_what_cannot_be_made_smaller_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def torn(points: np.ndarray, faces: np.ndarray, **_: object) -> tuple[np.ndarray, np.ndarray]:
        return points, faces[:100]

    said: list[str] = []
    monkeypatch.setattr(fast_simplification, "simplify", torn)
    solid = ball()
    assert within_budget("wing", solid, 1000, said.append) is solid
    assert len(said) == 1 and f"part 'wing' keeps {len(solid.faces)} faces" in said[0]


def test_a_shape_that_needs_more_faces_gets_them_and_that_is_told() -> None:
    said: list[str] = []
    small = within_budget("leaves", leaves(), 100, said.append)
    assert small.manifold and 100 < len(small.faces) < 1000
    (line,) = said
    assert line.startswith(f"--faces 100: part 'leaves' keeps {len(small.faces)} faces, ")
    assert line.endswith("; with fewer it would fall apart")


def test_a_shape_that_suffers_is_told() -> None:
    said: list[str] = []
    ring = trimesh.creation.torus(0.3, 0.05, 120, 40)
    small = within_budget("ring", Solid(ring.vertices, ring.faces), 150, said.append)
    assert len(small.faces) <= 150 and len(said) == 1 and "of its volume left" in said[0]


def test_every_level_is_told_with_how_far_it_is_off() -> None:
    said: list[str] = []
    full = ball(level=5)
    small = within_budget("wing", full, 2000, said.append)
    within_budget("wing", full, 10**6, said.append)
    (line, whole), off = said, largest_deviation(full, small)
    assert f"part 'wing' has {len(small.faces)} faces, {off:.3g} off the full surface" in line and "fall" not in line
    assert f"has its full surface, {len(full.faces)} faces" in whole
    # Equal triangles of a ball: their middles lie r - sqrt(r^2 - edge^2 / 3) deep.
    edge = np.sqrt(4 * np.pi * 0.25**2 / len(small.faces) * 4 / np.sqrt(3))
    assert 0.5 * edge**2 / (6 * 0.25) < off < 4 * edge**2 / (6 * 0.25)


def test_the_deviation_is_that_of_the_worse_side() -> None:
    spike = Solid(np.concatenate([ball().vertices[:-1], ball().vertices[-1:] * 2]), ball().faces)
    reach = np.linalg.norm(ball().vertices[-1])
    for one, other in ((ball(), spike), (spike, ball())):
        assert largest_deviation(one, other) == pytest.approx(reach, rel=1e-3)


def test_levels_are_read_as_people_write_them() -> None:
    assert read_levels(["1000,20000", "500"]) == [20000, 1000, 500]
    assert checked_levels(None) == [] and checked_levels(700) == [700]
    for wrong, named in ((["-5"], "-5"), (["5e3"], "5e3"), (["20"], "100 or more"), (["500", "500"], "twice")):
        with pytest.raises(UserError, match=named):
            read_levels(wrong)
    with pytest.raises(UserError, match="at most 8"):
        checked_levels(range(100, 110))


def test_levels_of_an_earlier_export_go(tmp_path: Path) -> None:
    for name in ("lod_200", "lod_600", "lod_notes", "glb"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "asset.glb").write_bytes(b"")
    remove_other_levels(tmp_path, [600])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["glb", "lod_600", "lod_notes"]
