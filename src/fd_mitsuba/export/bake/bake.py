"""Field values of a part as textures of its atlas.

Each texel is the mean of several samples. Samples in the gutter right beside a chart take the field's value where the
surface would go on, so that filtering at the chart's edge sees on both sides of a seam what the field has there; the
rest of the picture takes the nearest chart's value, so that no mip level mixes with a background.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

from fd_mitsuba.export.bake.atlas_raster import AtlasRaster, rasterise, weights_at
from fd_mitsuba.export.bake.tangents import face_directions, vertex_tangents
from fd_mitsuba.export.bake.unwrap import UnwrappedMesh
from fd_mitsuba.fields.tangent_frame import tangent_frame

_SAMPLES_AT_ONCE = 1 << 17
_REACH_TEXELS = 1.6
"""Bilinear filtering at a chart's edge reaches texels whose centre is up to sqrt(2) away."""
_CHANNELS = {"base_color": 3, "roughness": 1, "metallic": 1, "normal": 3, "normal_mitsuba": 3}


class Values(Protocol):
    """What a field says at N points: rows of tensors, colours linear.

    Attributes:
        base_color: (N, 3) in [0, 1].
        roughness: (N, 1) in [0, 1].
        metallic: (N, 1) in [0, 1].
        normal: (N, 3) unit, in the frame (tangent, bitangent, smooth normal) of `Frame`.
    """

    base_color: torch.Tensor
    roughness: torch.Tensor
    metallic: torch.Tensor
    normal: torch.Tensor


Field = Callable[[torch.Tensor], Any]
"""Points (N, 3) float32, canonical -> `Values`."""
Frame = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Smooth normals (N, 3) -> the tangent and bitangent (N, 3) that a field's `normal` refers to."""


@dataclass(frozen=True)
class TextureSet:
    """Textures of an atlas, float32, row 0 at v = 0, without holes.

    Attributes:
        base_color: (S, S, 3) linear.
        roughness: (S, S, 1).
        metallic: (S, S, 1).
        normal: (S, S, 3) unit, for `tangents.vertex_tangents`: x along growing u, y up in the picture.
        normal_mitsuba: the same for Mitsuba, which takes each triangle's own direction of u.
        covered: (S, S) bool, texels that touch a chart.
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal: np.ndarray
    normal_mitsuba: np.ndarray
    covered: np.ndarray

    @property
    def bends(self) -> bool:
        """Whether the normal map says anything: some normal is more than 0.1 degrees off."""
        return bool((self.normal[..., 2] < np.cos(np.radians(0.1))).any())


def bake(
    mesh: UnwrappedMesh, field: Field, texture_size: int, samples: int = 2, frame: Frame = tangent_frame
) -> TextureSet:
    """The textures of a field on an unwrapped mesh in the canonical frame.

    Args:
        texture_size: texels a side.
        samples: samples a side of each texel.
        frame: what the field's `normal` refers to.
    """
    raster = rasterise(mesh.uv, mesh.faces, texture_size * samples, _REACH_TEXELS * samples)
    sampler = _Sampler(mesh, raster, field, samples, frame)
    width = sum(_CHANNELS.values())
    total = np.zeros((texture_size * texture_size, width), dtype=np.float32)
    count = np.zeros(texture_size * texture_size, dtype=np.float32)
    side = raster.face.shape[1]
    hit = np.flatnonzero(raster.face.ravel() >= 0)
    for start in range(0, len(hit), _SAMPLES_AT_ONCE):
        chosen = hit[start : start + _SAMPLES_AT_ONCE]
        texel = (chosen // side // samples) * texture_size + chosen % side // samples
        first, last = int(texel.min()), int(texel.max()) + 1
        values = sampler(chosen)
        for column in range(width):
            total[first:last, column] += np.bincount(texel - first, values[:, column], last - first)
        count[first:last] += np.bincount(texel - first, minlength=last - first)
    known = (count > 0).reshape(texture_size, texture_size)
    total /= np.maximum(count, 1)[:, None]
    inside = (raster.face >= 0) & (raster.beyond == 0)
    covered = inside.reshape(texture_size, samples, texture_size, samples).any(axis=(1, 3))
    pictures, column = {}, 0
    for name, channels in _CHANNELS.items():
        picture = total[:, column : column + channels].reshape(texture_size, texture_size, channels)
        column += channels
        pictures[name] = np.ascontiguousarray(picture)
    del total
    fill_holes(list(pictures.values()), known)
    for name in ("normal", "normal_mitsuba"):
        length = np.linalg.norm(pictures[name], axis=-1, keepdims=True)
        pictures[name] = np.where(
            length > 1e-6, pictures[name] / np.maximum(length, 1e-6), np.array([0, 0, 1], np.float32)
        )
    return TextureSet(**pictures, covered=covered)


def bent_normals(mesh: UnwrappedMesh, field: Field, frame: Frame = tangent_frame) -> np.ndarray:
    """The shading normals (V, 3) at the vertices of a mesh in the canonical frame, bent as the field says."""
    with torch.no_grad():
        local = np.asarray(field(torch.from_numpy(mesh.vertices.astype(np.float32))).normal, dtype=np.float64)
    tangent, bitangent = frame(mesh.normals)
    return _unit(local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * mesh.normals)


def fill_holes(pictures: list[np.ndarray], known: np.ndarray) -> None:
    """Give every texel that is not `known` (H, W) the value of the nearest one that is, in place."""
    if known.all() or not known.any():
        return
    from scipy.ndimage import distance_transform_edt  # imported late: whoever only names formats needs none

    nearest: Any = distance_transform_edt(~known, return_distances=False, return_indices=True)
    rows, columns = nearest
    holes = ~known
    rows, columns = rows[holes], columns[holes]
    for picture in pictures:
        picture[holes] = picture[rows, columns]


class _Sampler:
    """Values of samples: base colour, roughness, metallic, and the normal in both tangent frames, (N, 11)."""

    def __init__(self, mesh: UnwrappedMesh, raster: AtlasRaster, field: Field, samples: int, frame: Frame) -> None:
        self.mesh, self.raster, self.field, self.frame = mesh, raster, field, frame
        self.side = raster.face.shape[0]
        self.tangents = vertex_tangents(mesh.vertices, mesh.faces, mesh.normals, mesh.uv)
        corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
        self.along_u, _ = face_directions(corners, uv)
        self.face_uv = uv
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
        sides = uv[:, 1:] - uv[:, :1]
        area_uv = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum()
        self.step = float(np.sqrt(area / max(area_uv, 1e-30))) / self.side  # a sample's usual width on the surface

    def __call__(self, chosen: np.ndarray) -> np.ndarray:
        face = self.raster.face.ravel()[chosen]
        places = (np.stack([chosen % self.side, chosen // self.side], axis=1) + 0.5) / self.side
        free, nearest = weights_at(self.face_uv[face], places)
        corners = self.mesh.faces[face]
        vertices = self.mesh.vertices[corners]
        points = np.einsum("nk,nkc->nc", nearest, vertices)
        onward = np.einsum("nk,nkc->nc", free - nearest, vertices)
        # Beyond a sliver the plane runs away; two usual steps a sample are enough anywhere.
        longest = 2.0 * self.step * self.raster.beyond.ravel()[chosen]
        onward *= np.minimum(1.0, longest / np.maximum(np.linalg.norm(onward, axis=1), 1e-30))[:, None]
        with torch.no_grad():
            values = self.field(torch.from_numpy((points + onward).astype(np.float32)))
        plain = [
            np.asarray(getattr(values, name), dtype=np.float64) for name in ("base_color", "roughness", "metallic")
        ]
        normal = _unit(np.einsum("nk,nkc->nc", nearest, self.mesh.normals[corners]))
        tangent, bitangent = self.frame(normal)
        local = np.asarray(values.normal, dtype=np.float64)
        bent = local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * normal
        smooth = self.tangents[corners]
        interpolated = _unit(np.einsum("nk,nkc->nc", nearest, smooth[..., :3]))
        handed = np.where(smooth[:, 0, 3] < 0, -1.0, 1.0)[:, None]
        own = _unit(self.along_u[face] - normal * _dot(self.along_u[face], normal))
        ones = np.ones((len(face), 1))
        return np.concatenate(
            [*plain, _in_frame(bent, interpolated, normal, handed), _in_frame(bent, own, normal, ones)], axis=1
        )


def _in_frame(vectors: np.ndarray, tangent: np.ndarray, normal: np.ndarray, handed: np.ndarray) -> np.ndarray:
    """Coordinates (x, y, z) with vectors = x tangent + y handed (normal x tangent) + z normal."""
    bitangent = handed * np.cross(normal, tangent)
    lean = _dot(tangent, normal)
    along_t, along_n = _dot(vectors, tangent), _dot(vectors, normal)
    free = np.maximum(1.0 - lean * lean, 1e-6)
    y = _dot(vectors, bitangent) / np.maximum(_dot(bitangent, bitangent), 1e-6)
    return np.concatenate([(along_t - lean * along_n) / free, y, (along_n - lean * along_t) / free], axis=1)


def _dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", first, second)[:, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
