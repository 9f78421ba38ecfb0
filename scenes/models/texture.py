"""UV coordinates for a mesh and textures painted through them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import xatlas
from PIL import Image
from scipy.ndimage import distance_transform_edt

from models.model import Model


@dataclass(frozen=True)
class Unwrapped:
    """A mesh cut open along seams: `vertices`, `normals` (V, 3), `uv` (V, 2) in [0, 1], `faces` (F, 3)."""

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray


def unwrap(surface: trimesh.Trimesh, resolution: int) -> Unwrapped:
    """The surface with an atlas of charts that do not overlap, packed for a texture of `resolution` pixels a side.

    Normals are those of the uncut surface, so that no seam shows in the shading.
    """
    atlas = xatlas.Atlas()
    atlas.add_mesh(surface.vertices.astype(np.float32), surface.faces.astype(np.uint32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost, charts.max_iterations = 6.0, 2
    packing.padding, packing.resolution, packing.bilinear = 2, resolution, True
    atlas.generate(charts, packing)
    source, faces, uv = atlas[0]
    normals = np.asarray(surface.vertex_normals)[source]
    return Unwrapped(surface.vertices[source], normals, np.asarray(uv), np.asarray(faces, np.int64))


def bake(mesh: Unwrapped, model: Model, resolution: int, seed: int) -> np.ndarray:
    """(R, R, 4) looks at every texel; row 0 is at v = 0, as Mitsuba reads a PLY. Gutters repeat the nearest chart."""
    position = np.zeros((resolution, resolution, 3), np.float32)
    normal = np.zeros_like(position)
    covered = np.zeros((resolution, resolution), bool)
    pixels = mesh.uv * resolution - 0.5
    for face in mesh.faces:
        corner = pixels[face]
        low = np.maximum(np.floor(corner.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(corner.max(axis=0)).astype(int), resolution - 1)
        x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        edges = np.column_stack([corner[1] - corner[0], corner[2] - corner[0]])
        area = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
        if abs(area) < 1e-12:
            continue
        dx, dy = x - corner[0, 0], y - corner[0, 1]
        b = (dx * edges[1, 1] - dy * edges[0, 1]) / area
        c = (dy * edges[0, 0] - dx * edges[1, 0]) / area
        slack = -1e-3
        inside = (b >= slack) & (c >= slack) & (b + c <= 1 - slack)
        rows, columns = y[inside], x[inside]
        weights = np.column_stack([1 - b[inside] - c[inside], b[inside], c[inside]])
        position[rows, columns] = weights @ mesh.vertices[face]
        normal[rows, columns] = weights @ mesh.normals[face]
        covered[rows, columns] = True
    points, normals = position[covered], normal[covered]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    picture = np.zeros((resolution, resolution, 4), np.float32)
    blocks = zip(np.array_split(points, 8), np.array_split(normals, 8), strict=True)
    picture[covered] = np.concatenate([model.looks(p, n, seed) for p, n in blocks])
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return picture[tuple(nearest)]


def write_textures(stem: Path, picture: np.ndarray) -> list[Path]:
    """Writes `<stem>_base_color.png` (8-bit sRGB) and, where roughness varies, `<stem>_roughness.png` (linear grey)."""
    linear = picture[..., :3]
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    # Steps of 3 in 255 are below the fine pattern's contrast and halve the file.
    codes = np.clip(np.rint(srgb * 255 / 3) * 3, 0, 255).astype(np.uint8)
    written = [stem.with_name(f"{stem.name}_base_color.png")]
    Image.fromarray(codes).save(written[0], optimize=True)
    roughness = picture[..., 3]
    if np.ptp(roughness) > 0.02:
        size = picture.shape[0] // 2
        half = roughness.reshape(size, 2, size, 2).mean(axis=(1, 3))
        written.append(stem.with_name(f"{stem.name}_roughness.png"))
        Image.fromarray((np.rint(half * 255 / 4) * 4).clip(0, 255).astype(np.uint8)).save(written[1], optimize=True)
    return written
