"""What a surface can be shown as besides its materials under a light: its own colours, or the normals of its faces."""

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
