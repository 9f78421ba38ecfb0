"""What a surface can be shown as besides its materials: its own colours, its normals, or a material tried on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pygltflib as gltf

from fd_mitsuba.assets.crease_normals import crease_normals
from fd_mitsuba.export.gltf import GltfMesh, glb_bytes
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.io.srgb import linear_from_srgb

LIT, COLOURS, NORMALS = "lit", "base colour", "normals"
SHADINGS = (LIT, COLOURS, NORMALS)

OWN = "as learned"
MATERIALS: dict[str, PbrMaterial | None] = {
    OWN: None,
    "clay": PbrMaterial("clay", (0.5, 0.5, 0.5), 0.8),
    "gold": PbrMaterial("gold", (1.0, 0.71, 0.29), 0.25, 1.0),
    "silver": PbrMaterial("silver", (0.96, 0.95, 0.92), 0.2, 1.0),
    "glossy white": PbrMaterial("glossy white", (0.8, 0.8, 0.8), 0.1),
    "rubber": PbrMaterial("rubber", (0.03, 0.03, 0.03), 0.7),
}
"""What can be tried on a part, colours linear: none is of the run or in what is downloaded."""

_UNLIT = "KHR_materials_unlit"


def unlit(glb: bytes) -> bytes:
    """A GLB whose colours and textures are seen as they are, without any light."""
    file = gltf.GLTF2.load_from_bytes(glb)
    assert file is not None
    for material in file.materials:
        material.extensions = {_UNLIT: {}}
    kept = [name for name in file.extensionsUsed if not name.startswith("KHR_materials_")]  # such as those of textures
    file.extensionsUsed = [*kept, _UNLIT]
    return b"".join(file.save_to_bytes())


def dressed(glb: bytes, material: PbrMaterial) -> bytes:
    """A GLB all of whose surfaces have one plain material; what their normal maps show stays."""
    file = gltf.GLTF2.load_from_bytes(glb)
    assert file is not None
    for one in file.materials:
        one.extensions = {}
        one.pbrMetallicRoughness = gltf.PbrMetallicRoughness(
            baseColorFactor=[*material.base_color, 1.0],
            metallicFactor=material.metallic,
            roughnessFactor=material.roughness,
        )
    for mesh in file.meshes:
        for primitive in mesh.primitives:
            primitive.attributes.COLOR_0 = None  # pyright: ignore[reportAttributeAccessIssue]
    return b"".join(file.save_to_bytes())


def solid_glb(vertices: np.ndarray, faces: np.ndarray, material: PbrMaterial) -> bytes:
    """A mesh (V, 3), (F, 3) of one material, smooth but for sharp edges."""
    if not len(faces):
        return glb_bytes([], {})
    vertices = np.asarray(vertices, dtype=np.float64)
    copies, normals, corners = crease_normals(vertices, np.asarray(faces))
    return glb_bytes([GltfMesh(material.name, vertices[copies], corners, material, normals)], {})


def normals_glb(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A mesh (V, 3), (F, 3) coloured by its normals, smooth but for sharp edges: sRGB is (n + 1) / 2."""
    if not len(faces):
        return glb_bytes([], {})
    vertices = np.asarray(vertices, dtype=np.float64)
    copies, normals, corners = crease_normals(vertices, np.asarray(faces))
    colours = linear_from_srgb((normals + 1) / 2)
    plain = replace(PbrMaterial("normals"), base_color=(1.0, 1.0, 1.0), double_sided=True)
    mesh = GltfMesh("normals", vertices[copies], corners, plain, normals, colours=colours)
    return unlit(glb_bytes([mesh], {}))
