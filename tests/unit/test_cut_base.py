"""Cuts out of textured meshes: volumes in closed form, and what must not change."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.solid.cut_base import CutMesh, cut_mesh
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.scene.tessellate import unit_sphere


def box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A box of side 2 whose six faces have vertices, and so UVs, of their own: u, v = position plus 10 a face."""
    vertices, faces, uv = [], [], []
    for axis in range(3):
        for sign in (-1, 1):
            first, second = [i for i in range(3) if i != axis]
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, first], corners[:, second] = [-1, 1, 1, -1], [-1, -1, 1, 1]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            order = [0, 1, 2, 3] if normal[axis] * sign > 0 else [3, 2, 1, 0]
            start = 4 * len(vertices)
            faces += [[start + order[i] for i in triangle] for triangle in ((0, 1, 2), (0, 2, 3))]
            vertices.append(corners)
            uv.append(corners[:, [first, second]] + 10 * (2 * axis + (sign > 0)))
    return np.concatenate(vertices), np.array(faces), np.concatenate(uv)


def ball(centre: tuple[float, float, float], radius: float) -> Solid:
    vertices, faces = unit_sphere(4)
    return Solid(vertices * radius + np.array(centre), faces)


def mesh(cut: CutMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(cut.vertices, cut.faces, process=False).copy()


def test_a_bite_has_the_volume_of_the_solid_and_nothing_else_changes() -> None:
    vertices, faces, uv = box()
    solid = ball((1.0, 0.0, 0.0), 0.5)
    cut = cut_mesh("box", vertices, faces, uv, solid)
    welded = mesh(cut)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    assert welded.is_watertight
    assert 8 - welded.volume == pytest.approx(2 / 3 * math.pi * 0.5**3, rel=0.02)
    assert 8 - welded.volume == pytest.approx(solid.volume / 2, rel=1e-3)
    assert np.array_equal(cut.vertices[: len(vertices)], vertices) and np.array_equal(cut.attributes[: len(uv)], uv)
    assert cut.untouched.sum() == 10 and np.array_equal(cut.faces[cut.untouched], faces[cut.source[cut.untouched]])
    assert set(range(12)) - set(cut.source[cut.untouched]) == {2, 3} and set(cut.source) == {-1, *range(12)}


def test_split_triangles_keep_their_uvs_by_interpolation() -> None:
    vertices, faces, uv = box()
    cut = cut_mesh("box", vertices, faces, uv, ball((1.0, 0.3, 0.1), 0.4))
    split = (cut.source >= 0) & ~cut.untouched
    assert split.sum() > 10
    points, values = cut.vertices[cut.faces[split]], cut.attributes[cut.faces[split]]
    assert np.all(points[..., 0] == 1)  # only the bitten side is split
    assert np.allclose(values, points[..., 1:] + 10, atol=1e-9)
    inner = cut.faces[cut.source < 0]
    distance = np.linalg.norm(cut.vertices[inner] - np.array([1.0, 0.3, 0.1]), axis=-1)
    assert np.abs(distance - 0.4).max() < 0.01 and len(inner) > 50


def test_a_solid_beside_the_mesh_cuts_nothing() -> None:
    vertices, faces, uv = box()
    cut = cut_mesh("box", vertices, faces, uv, ball((4.0, 0.0, 0.0), 0.5))
    assert np.array_equal(cut.faces, faces) and np.array_equal(cut.vertices, vertices)
    assert np.array_equal(cut.attributes, uv) and cut.untouched.all()


def test_a_mesh_without_attributes() -> None:
    vertices, faces = unit_sphere(4)
    solid = ball((0.0, 1.0, 0.0), 0.5)
    cut = cut_mesh("ball", vertices, faces, np.zeros((len(vertices), 0)), solid)
    sides = 1.0**2 + 2 * 1.5 - 3 * 0.5**2
    lens = math.pi * (1 + 0.5 - 1.0) ** 2 * sides / 12
    welded = mesh(cut)
    welded.merge_vertices()
    assert welded.is_watertight
    assert trimesh.Trimesh(vertices, faces).volume - welded.volume == pytest.approx(lens, rel=0.02)
    assert cut.untouched.sum() > 0.8 * len(faces)


def test_open_meshes_and_broken_solids_are_refused_in_one_line() -> None:
    vertices, faces, uv = box()
    solid = ball((1.0, 0.0, 0.0), 0.5)
    with pytest.raises(UserError, match="base 'box': is not closed"):
        cut_mesh("box", vertices, faces[2:], uv, solid)
    with pytest.raises(UserError, match="no closed solid"):
        cut_mesh("box", vertices, faces, uv, Solid(solid.vertices, solid.faces[1:]))
