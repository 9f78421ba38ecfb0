"""Tiled textures: what OBJ's and glTF's own words make of a UV is the texel that the picture's tiling means."""

from __future__ import annotations

import re

import numpy as np
import pytest
from pygltflib import GLTF2

from fd_mitsuba.export.gltf import GltfMesh, glb_bytes
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.export.obj import ObjMesh, obj_files
from fd_mitsuba.export.pictures import Picture, png

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2]])
UV = np.array([[0.1, 0.2], [0.9, 0.35], [0.4, 0.75]], np.float32)
OFFSET, SCALE = (0.3, 0.15), (2.0, 5.0)


def tiled(name: str) -> Picture:
    return Picture(name, png(np.full((2, 2, 3), 0.5)), tiling=(OFFSET, SCALE))


MATERIAL = PbrMaterial(
    "tiled", base_picture=tiled("a_base"), orm_picture=tiled("a_orm"), normal_picture=tiled("a_bump")
)
PLAIN = PbrMaterial("plain", base_picture=Picture("p_base", png(np.zeros((1, 1, 3)))))
EXPECTED = np.array(OFFSET) + np.array(SCALE) * UV


def test_obj_options_lead_to_the_same_texels() -> None:
    """OBJ looks up at -o + -s * vt, with v upwards; ours has v downwards."""
    files = obj_files([ObjMesh("tiled", VERTICES, FACES, MATERIAL, uv=UV)])
    places = re.findall(r"^vt (\S+) (\S+)$", files["asset.obj"].decode(), re.MULTILINE)
    upwards = np.array(places, np.float64)
    options = re.findall(
        r"^(map_Kd|map_Pr|map_Pm|norm|map_Bump -bm 1) -o (\S+) (\S+) 0 -s (\S+) (\S+) 1 \S+$",
        files["asset.mtl"].decode(),
        re.MULTILINE,
    )
    assert [word for word, *_ in options] == ["map_Kd", "map_Pr", "map_Pm", "norm", "map_Bump -bm 1"]
    for _, *numbers in options:
        offset, scale = np.array(numbers, np.float64).reshape(2, 2)
        looked_up = offset + scale * upwards
        looked_up[:, 1] = 1 - looked_up[:, 1]
        np.testing.assert_allclose(looked_up, EXPECTED, atol=1e-5)


def test_a_picture_that_is_not_tiled_has_no_options() -> None:
    lines = obj_files([ObjMesh("plain", VERTICES, FACES, PLAIN, uv=UV)])["asset.mtl"].decode().splitlines()
    assert "map_Kd p_base.png" in lines


def test_gltf_transform_leads_to_the_same_texels() -> None:
    """KHR_texture_transform looks up at offset + scale * uv, with v downwards as ours."""
    file = GLTF2.load_from_bytes(glb_bytes([GltfMesh("tiled", VERTICES, FACES, MATERIAL, uv=UV)], {}))
    assert file.extensionsUsed == ["KHR_texture_transform"]
    material = file.materials[0]
    surface = material.pbrMetallicRoughness
    for info in (surface.baseColorTexture, surface.metallicRoughnessTexture, material.normalTexture):
        transform = info.extensions["KHR_texture_transform"]
        looked_up = np.array(transform["offset"]) + np.array(transform["scale"]) * UV
        np.testing.assert_allclose(looked_up, EXPECTED, atol=1e-6)
    accessor = file.accessors[file.meshes[0].primitives[0].attributes.TEXCOORD_0]
    view = file.bufferViews[accessor.bufferView]
    begin = view.byteOffset + (accessor.byteOffset or 0)
    stored = np.frombuffer(file.binary_blob()[begin : begin + 24], np.float32).reshape(3, 2)
    assert stored == pytest.approx(UV)
