"""Baked textures against the field itself: on the surface, across seams, in mip levels, in memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from skimage.measure import marching_cubes
from test_unwrap import knot

from fd_mitsuba.evaluation.atlas_faults import seam_jumps
from fd_mitsuba.export.bake.bake import TextureSet, bake, fill_holes
from fd_mitsuba.export.bake.tangents import vertex_tangents
from fd_mitsuba.export.bake.unwrap import UnwrappedMesh, unwrap
from fd_mitsuba.export.pictures import part_pictures
from fd_mitsuba.fields.tangent_frame import tangent_frame
from fd_mitsuba.io.srgb import srgb_from_linear

SIZE = 512


@dataclass
class Material:
    base_color: torch.Tensor
    roughness: torch.Tensor
    metallic: torch.Tensor
    normal: torch.Tensor


def field(points: torch.Tensor) -> Material:
    """Smooth in space, every channel different, never black."""
    colour = 0.5 + 0.35 * torch.sin(3 * points + torch.tensor([0.0, 1.0, 2.0]))
    slope = 0.4 * torch.stack([torch.sin(5 * points[:, 1]), torch.cos(4 * points[:, 2]), 2.5 + 0 * points[:, 0]], dim=1)
    normal = slope / slope.norm(dim=1, keepdim=True)
    return Material(colour, 0.3 + 0.2 * colour[:, :1], 0.5 + 0.4 * torch.cos(4 * points[:, :1]), normal)


@pytest.fixture(scope="module")
def mesh() -> UnwrappedMesh:
    return unwrap(*knot(), SIZE)


@pytest.fixture(scope="module")
def textures(mesh: UnwrappedMesh) -> TextureSet:
    return bake(mesh, field, SIZE)


def sampled(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear, as a GPU does it."""
    places = [uv[:, 1] * picture.shape[0] - 0.5, uv[:, 0] * picture.shape[1] - 0.5]
    channels = [map_coordinates(picture[..., c], places, order=1, mode="nearest") for c in range(picture.shape[-1])]
    return np.stack(channels, axis=1)


def on_surface(mesh: UnwrappedMesh, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Faces (N,), weights (N, 3), points and UVs."""
    random = np.random.default_rng(1)
    face = random.integers(len(mesh.faces), size=count)
    weights = random.dirichlet([0.6, 0.6, 0.6], size=count)
    corners = mesh.faces[face]
    return (
        face,
        weights,
        np.einsum("nk,nkc->nc", weights, mesh.vertices[corners]),
        np.einsum("nk,nkc->nc", weights, mesh.uv[corners]),
    )


def says(points: np.ndarray) -> Material:
    return field(torch.from_numpy(points.astype(np.float32)))


def seam_edges(mesh: UnwrappedMesh) -> np.ndarray:
    """Pairs of edges (E, 2, 2) in split vertices that are one edge of the input."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    original = mesh.vertex_map[edges]
    order = np.argsort(original, axis=1)
    edges = np.take_along_axis(edges, order, axis=1)
    original = np.take_along_axis(original, order, axis=1)
    by_edge = np.lexsort((original[:, 1], original[:, 0]))
    first, second = edges[by_edge[0::2]], edges[by_edge[1::2]]
    assert np.array_equal(mesh.vertex_map[first], mesh.vertex_map[second])
    return np.stack([first, second], axis=1)[np.any(first != second, axis=1)]


def test_textures_say_what_the_field_says(mesh: UnwrappedMesh, textures: TextureSet) -> None:
    _, _, points, uv = on_surface(mesh, 20000)
    values = says(points)
    for name in ("base_color", "roughness", "metallic"):
        error = np.abs(sampled(getattr(textures, name), uv) - getattr(values, name).numpy())
        assert np.quantile(error, 0.99) < 2 / 255 and error.max() < 6 / 255, name


def test_normal_map_bends_as_the_field_does(mesh: UnwrappedMesh, textures: TextureSet) -> None:
    face, weights, points, uv = on_surface(mesh, 5000)
    corners = mesh.faces[face]
    tangents = vertex_tangents(mesh.vertices, mesh.faces, mesh.normals, mesh.uv)[corners]
    normal = np.einsum("nk,nkc->nc", weights, mesh.normals[corners])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.einsum("nk,nkc->nc", weights, tangents[..., :3])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    x, y, z = sampled(textures.normal, uv).T[..., None]
    shown = x * tangent + y * tangents[:, 0, 3:] * np.cross(normal, tangent) + z * normal
    shown /= np.linalg.norm(shown, axis=1, keepdims=True)
    first, second = tangent_frame(normal)
    u, v, w = says(points).normal.numpy().astype(np.float64).T[..., None]
    wanted = u * first + v * second + w * normal
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", shown, wanted), -1, 1)))
    assert np.median(angle) < 0.3 and np.quantile(angle, 0.99) < 2.0
    bend = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normal, wanted), -1, 1)))
    assert np.median(bend) > 10


def test_no_colour_jump_across_seams(mesh: UnwrappedMesh) -> None:
    """The 8-bit sRGB picture, filtered at full size: both sides of each seam agree to 2/255 (the field has no jump)."""
    picture = part_pictures("x", bake(mesh, field, SIZE))["base_color"].pixels().astype(np.float64)
    edges = seam_edges(mesh)
    assert len(edges) > 50
    for share in (0.1, 0.5, 0.8):
        ends = mesh.uv[edges]
        uv = ends[:, :, 0] * (1 - share) + ends[:, :, 1] * share
        jump = np.abs(sampled(picture, uv[:, 0]) - sampled(picture, uv[:, 1]))
        assert jump.max() <= 2.0


def crown(side: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A ring with six points as a surface extractor makes it: with slivers, and charts that close on themselves."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, side)] * 3, indexing="ij")
    top = 0.1 + 0.35 * np.cos(6 * np.arctan2(z, x))
    inside = np.minimum.reduce([0.13 - np.abs(np.hypot(x, z) - 0.6), y + 0.5, top - y])
    vertices, faces, _, _ = marching_cubes(inside, 0)
    return vertices[:, ::-1] / (side - 1) * 2.0 - 1.0, faces.astype(np.int64)


def test_no_colour_jump_on_an_extracted_surface_either() -> None:
    made = unwrap(*crown(), SIZE)
    picture = part_pictures("x", bake(made, field, SIZE))["base_color"].pixels()
    found = seam_jumps(
        made.vertices, made.faces, made.uv, picture, lambda p: 255 * srgb_from_linear(says(p).base_color.numpy())
    )
    assert found["seams"] > 500 and found["beyond_own"] <= 2.0
    assert found["jump"] <= 3.0


def test_mip_level_3_has_nothing_of_a_background(mesh: UnwrappedMesh, textures: TextureSet) -> None:
    """Halved three times by averaging: only the field's own colours, at worst those of 8 texels further."""
    small = textures.base_color.astype(np.float64)
    for _ in range(3):
        small = (small[0::2, 0::2] + small[1::2, 0::2] + small[0::2, 1::2] + small[1::2, 1::2]) / 4
    low, high = textures.base_color[textures.covered].min(axis=0), textures.base_color[textures.covered].max(axis=0)
    assert np.all(small >= low - 0.03) and np.all(small <= high + 0.03)
    _, _, points, uv = on_surface(mesh, 20000)
    error = np.abs(sampled(small, uv) - says(points).base_color.numpy())
    assert np.median(error) < 0.04


def test_every_texel_is_filled(textures: TextureSet) -> None:
    for name in ("base_color", "roughness", "metallic"):
        assert getattr(textures, name).min() > 0
    assert np.allclose(np.linalg.norm(textures.normal, axis=-1), 1, atol=1e-5)


def test_holes_take_the_nearest_value() -> None:
    picture = np.zeros((5, 7, 1), dtype=np.float32)
    known = np.zeros((5, 7), dtype=bool)
    picture[2, 1], picture[4, 6] = 3.0, 5.0
    known[2, 1] = known[4, 6] = True
    fill_holes([picture], known)
    y, x = np.mgrid[0:5, 0:7]
    nearer = np.hypot(y - 2, x - 1) < np.hypot(y - 4, x - 6)
    assert np.array_equal(picture[..., 0], np.where(nearer, 3.0, 5.0))


def test_plain_normals_need_no_map(mesh: UnwrappedMesh) -> None:
    def flat(points: torch.Tensor) -> Material:
        values = field(points)
        values.normal = torch.tensor([0.0, 0.0, 1.0]).expand(len(points), 3)
        return values

    assert set(part_pictures("x", bake(mesh, flat, 64))) == {"base_color", "orm", "roughness", "metallic"}
    assert set(part_pictures("x", bake(mesh, field, 64))) > {"normal", "normal_mitsuba"}


def test_srgb_curve() -> None:
    assert srgb_from_linear(np.array([0.0, 1.0, 0.214041, 2.0])) == pytest.approx([0, 1, 0.5, 1], abs=1e-4)
