"""What a 3D file holds, whatever its format: meshes of one material each, materials, textures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Wrap = Literal["repeat", "mirror", "clamp"]
AlphaMode = Literal["OPAQUE", "MASK", "BLEND"]

MOST_FACES = 4_000_000
"""Of an asset: beyond, a run takes hours for what a tenth of the faces shows as well."""


@dataclass(frozen=True)
class TextureImage:
    """An image file in memory that was looked at: its size is bearable and its header sound.

    Attributes:
        name: as in the asset; not safe as a file's name.
        data: the file's bytes, PNG or JPEG.
        suffix: ".png" or ".jpg".
    """

    name: str
    data: bytes
    suffix: str


@dataclass(frozen=True)
class Texture:
    """An image as a material looks it up.

    Attributes:
        image: what is looked up.
        to_uv: (3, 3) affine map from the mesh's UVs, origin top left, to those of the image.
        wrap: beyond the unit square.
        nearest: no filtering.
        channel: 0 to 3, the channel that holds a single number; None: colours.
        uv_set: which of the mesh's UV sets it is looked up by.
    """

    image: TextureImage
    to_uv: np.ndarray = field(default_factory=lambda: np.eye(3))
    wrap: Wrap = "repeat"
    nearest: bool = False
    channel: int | None = None
    uv_set: int = 0


@dataclass(frozen=True)
class AssetMaterial:
    """A metallic-roughness material, as glTF means it; a texture is multiplied by the number beside it.

    Attributes:
        name: as in the asset.
        base_color: linear in [0, 1].
        base_texture: sRGB.
        opacity: multiplies the alpha of `opacity_texture`.
        opacity_texture: its `channel` is the alpha.
        alpha_mode: OPAQUE ignores both.
        alpha_cutoff: from which alpha on a MASK shows.
        normal_texture: tangent space, +x right and +y up in the image.
        double_sided: whether both sides show.
        unlit: whether its colours are meant to be seen as they are.
    """

    name: str = ""
    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    base_texture: Texture | None = None
    roughness: float = 0.6
    roughness_texture: Texture | None = None
    metallic: float = 0.0
    metallic_texture: Texture | None = None
    opacity: float = 1.0
    opacity_texture: Texture | None = None
    alpha_mode: AlphaMode = "OPAQUE"
    alpha_cutoff: float = 0.5
    normal_texture: Texture | None = None
    double_sided: bool = False
    unlit: bool = False
    transmission: float = 0.0
    ior: float = 1.5
    specular: float = 1.0
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0

    @property
    def textures(self) -> tuple[Texture, ...]:
        """All that it looks up."""
        found = (
            self.base_texture,
            self.roughness_texture,
            self.metallic_texture,
            self.opacity_texture,
            self.normal_texture,
        )
        return tuple(texture for texture in found if texture is not None)


@dataclass(frozen=True)
class AssetMesh:
    """Triangles of one material at one place.

    Attributes:
        name: as in the asset.
        vertices: (V, 3) float64 in its own frame.
        faces: (F, 3) int64, every index in [0, V), counter-clockwise seen from outside.
        material: number in `Asset.materials`; -1: none.
        normals: (V, 3) unit; None: flat faces.
        uvs: UV sets, (V, 2) each, origin top left.
        colours: (V, 3) linear in [0, 1].
        to_asset: (4, 4) affine, to the asset's frame.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    material: int = -1
    normals: np.ndarray | None = None
    uvs: dict[int, np.ndarray] = field(default_factory=dict)
    colours: np.ndarray | None = None
    to_asset: np.ndarray = field(default_factory=lambda: np.eye(4))

    def placed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Vertices (V, 3), faces (F, 3) running outwards and unit normals (V, 3), all in the asset's frame."""
        linear = self.to_asset[:3, :3]
        vertices = self.vertices @ linear.T + self.to_asset[:3, 3]
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        if self.normals is None:
            return vertices, faces, None
        normals = self.normals @ np.linalg.pinv(linear)
        return vertices, faces, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


@dataclass(frozen=True)
class Asset:
    """All that was read.

    Attributes:
        meshes: in the file's order.
        materials: that the meshes refer to.
        up: the axis that points up where the format or the file says so, such as "+y".
        front: the axis that the object looks along, likewise.
        unit: "mm", "cm" or "m", likewise.
        flat: whether meshes without normals have flat faces; else they are smooth but for sharp edges.
        notes: what was left out or understood in another way, a sentence each.
        packed: the mesh file in an archive that it was read from; "": the file was the mesh.
    """

    meshes: tuple[AssetMesh, ...]
    materials: tuple[AssetMaterial, ...] = ()
    up: str | None = None
    front: str | None = None
    unit: str | None = None
    flat: bool = False
    notes: tuple[str, ...] = ()
    packed: str = ""
