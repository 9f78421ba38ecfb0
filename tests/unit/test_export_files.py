"""OBJ, GLB and PLY number by number: what a mesh and its material say is in the file, once, and nothing else is."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gltf
import pytest
from PIL import Image

from fd_mitsuba.export.gltf import ROOT_NAME, GltfMesh, glb_bytes, is_placement
from fd_mitsuba.export.material import PbrMaterial
from fd_mitsuba.export.obj import ObjMesh, obj_files, ply_with_uv
from fd_mitsuba.export.pictures import Picture, png

RANDOM = np.random.default_rng(0)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = RANDOM.random((4, 2)).astype(np.float32)
COLOURS = np.array([[0, 0.2, 1], [1, 0, 0], [0.5, 0.5, 0.5], [0, 1, 0]], np.float32)


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


VERTICES = RANDOM.normal(size=(4, 3)).astype(np.float32)
NORMALS = unit(RANDOM.normal(size=(4, 3)))
TANGENTS = np.concatenate([unit(RANDOM.normal(size=(4, 3))), [[1], [-1], [1], [1]]], axis=1).astype(np.float32)


def see_through() -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.full((2, 3, 4), 90, np.uint8)).save(stream, format="PNG")
    return stream.getvalue()


ORM = np.array([[[1.0, 0.2, 0.6], [1.0, 0.4, 0.8]]])
BASE = Picture("a_base", see_through(), wrap="clamp")
ROUGH = Picture("a_orm", png(ORM), wrap="mirror", tiling=((0.0, 0.0), (2.0, 1.0)), rotation=0.25)
BUMP = Picture("a_bump", png(np.full((1, 1, 3), 0.5)), nearest=True)
RICH = PbrMaterial(
    "rich", (0.1, 0.2, 0.3), 0.7, 0.9, 0.8, True, 1.33, 0.3, 0.25, 0.4, 0.15, BASE, ROUGH, BUMP, alpha_mode="BLEND",
    notes=("no sheen",),
)  # fmt: skip
PLAIN = PbrMaterial("plain", (0.4, 0.5, 0.6), roughness=0.7, metallic=0.2)


def obj_numbers(text: str) -> dict[str, dict[str, np.ndarray]]:
    """Group -> its corners (F, 3, ...) of "v", "vt" and "vn", as its faces look them up among all of the file."""
    rows: dict[str, list] = {"v": [], "vt": [], "vn": []}
    faces: dict[str, list] = {}
    for word, *values in (line.split() for line in text.splitlines()):
        if word in rows:
            rows[word].append([float(value) for value in values])
        elif word == "g":
            faces[group := values[0]] = []
        elif word == "f":
            faces[group].append([[int(part) if part else 0 for part in value.split("/")] for value in values])
    found = {}
    for group, corners in faces.items():
        numbers = np.array(corners)
        words = ("v", "vt", "vn")[: numbers.shape[2]]
        columns = {word: numbers[..., column] - 1 for column, word in enumerate(words) if numbers[..., column].any()}
        found[group] = {word: np.array(rows[word])[column] for word, column in columns.items()}
    return found


def materials(text: str) -> dict[str, list[str]]:
    blocks = [block.splitlines() for block in text.strip().split("\n\n")]
    return {lines[0].removeprefix("newmtl "): lines[1:] for lines in blocks}


def test_each_group_of_an_obj_has_its_own_numbers() -> None:
    kinds: dict[str, dict[str, np.ndarray]] = {
        "all": {"normals": NORMALS, "uv": UV},
        "nothing": {},
        "uv": {"uv": UV[::-1]},
        "normals": {"normals": NORMALS[::-1]},
        "again": {"normals": -NORMALS, "uv": 1 - UV},
    }
    meshes = [
        ObjMesh(name, VERTICES + shift, FACES, PLAIN, **arrays) for shift, (name, arrays) in enumerate(kinds.items())
    ]
    found = obj_numbers(obj_files(meshes)["asset.obj"].decode())
    assert list(found) == list(kinds)
    for shift, (name, arrays) in enumerate(kinds.items()):
        np.testing.assert_array_equal(found[name]["v"].astype(np.float32), (VERTICES + np.float32(shift))[FACES])
        assert set(found[name]) == {"v"} | {{"uv": "vt", "normals": "vn"}[key] for key in arrays}
        if "normals" in arrays:
            np.testing.assert_array_equal(found[name]["vn"].astype(np.float32), arrays["normals"][FACES])
        if "uv" in arrays:  # v runs up in an OBJ
            upwards = np.stack([arrays["uv"][:, 0], 1 - arrays["uv"][:, 1].astype(np.float64)], axis=1)
            np.testing.assert_allclose(found[name]["vt"], upwards[FACES], atol=1e-8)


def test_the_lines_of_an_obj_in_their_order() -> None:
    files = obj_files([ObjMesh("a leaf", VERTICES, FACES[:1], PLAIN), ObjMesh("a_leaf", VERTICES, FACES[1:], PLAIN)])
    assert list(files) == ["asset.obj", "asset.mtl"]
    lines = [line for line in files["asset.obj"].decode().split("\n") if not line.startswith("v ")]
    start = ["mtllib asset.mtl", "o a_leaf", "g a_leaf", "usemtl a_leaf", "f 1 2 3"]
    assert lines == [*start, "o a_leaf_2", "g a_leaf_2", "usemtl a_leaf_2", "f 5 7 8", ""]
    assert list(obj_files([], name="tree")) == ["tree.obj", "tree.mtl"]
    assert obj_files([], name="tree")["tree.obj"] == b"mtllib tree.mtl\n"


def test_vertex_colours_of_an_obj_are_srgb_behind_the_position() -> None:
    text = obj_files([ObjMesh("all", VERTICES, FACES, PLAIN, colours=COLOURS)])["asset.obj"].decode()
    rows = np.array([line.split()[1:] for line in text.splitlines() if line.startswith("v ")], np.float64)
    np.testing.assert_array_equal(rows[:, :3].astype(np.float32), VERTICES)
    expected = np.where(COLOURS <= 0.0031308, 12.92 * COLOURS, 1.055 * COLOURS.clip(1e-9) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(rows[:, 3:], expected, atol=1e-6)


def test_positions_far_away_have_fifteen_digits() -> None:
    far = VERTICES.astype(np.float64) + 45200.123456789
    found = obj_numbers(obj_files([ObjMesh("far", far, FACES, PLAIN)])["asset.obj"].decode())["far"]["v"]
    np.testing.assert_allclose(found, far[FACES], rtol=1e-14)
    assert np.abs(far.astype(np.float32) - far).max() > 1e-4


def test_materials_of_an_obj_line_by_line() -> None:
    plain = PbrMaterial("x", (0.4, 0.5, 0.6), 0.7, 0.2, specular=0.0, ior=1.25, opacity=0.5, transmission=0.5)
    names = [ObjMesh("rich", VERTICES, FACES, RICH), ObjMesh("plain", VERTICES, FACES, plain)]
    files = obj_files(names)
    found = materials(files["asset.mtl"].decode())
    assert found["plain"] == [
        "Kd 0.4 0.5 0.6", "Ks 0 0 0", "Ni 1.25", "d 0.25", "illum 2", "Pr 0.7", "Pm 0.2"
    ]  # fmt: skip
    assert found["rich"] == [
        "Kd 0.1 0.2 0.3", "Ks 0.5 0.5 0.5", "Ni 1.33", "d 0.6", "illum 2", "Pr 1", "Pm 1",
        "map_Kd -clamp on a_base.png", "map_d -clamp on a_base.png",
        "map_Pr -o 0 0 0 -s 2 1 1 a_roughness.png", "map_Pm -o 0 0 0 -s 2 1 1 a_metallic.png",
        "norm a_bump.png", "map_Bump -bm 1 a_bump.png",
    ]  # fmt: skip
    assert files["a_base.png"] == BASE.data and files["a_bump.png"] == BUMP.data
    for name, channel in (("a_roughness.png", 1), ("a_metallic.png", 2)):
        stored = np.asarray(Image.open(io.BytesIO(files[name])))
        np.testing.assert_allclose(stored / 255, ORM[..., channel], atol=1 / 500)
    assert len(files) == 6


def test_a_picture_is_a_mask_only_where_its_alpha_counts() -> None:
    solid = Picture("solid", png(np.zeros((1, 1, 3))))
    for picture, mode, expected in ((BASE, "BLEND", 1), (BASE, "MASK", 1), (BASE, "OPAQUE", 0), (solid, "MASK", 0)):
        made: Any = PbrMaterial("x", base_picture=picture, alpha_mode=mode)
        text = obj_files([ObjMesh("x", VERTICES, FACES, made)])["asset.mtl"].decode()
        assert text.count("map_d ") == expected


def test_pictures_of_one_name_are_one_file_only_where_they_are_equal() -> None:
    one, other = (Picture("leaf", png(np.full((1, 1, 3), grey)), suffix=".png") for grey in (0.2, 0.9))
    meshes = [
        ObjMesh(name, VERTICES, FACES, PbrMaterial(name, base_picture=picture))
        for name, picture in (("a", one), ("b", other), ("c", one), ("d", Picture("x", b"jpeg", suffix=".jpg")))
    ]
    files = obj_files(meshes)
    places = {name: lines[-1] for name, lines in materials(files["asset.mtl"].decode()).items()}
    expected = {"a": "leaf.png", "b": "leaf_2.png", "c": "leaf.png", "d": "x.jpg"}
    assert places == {name: f"map_Kd {file}" for name, file in expected.items()}
    assert (files["leaf.png"], files["leaf_2.png"], files["x.jpg"]) == (one.data, other.data, b"jpeg")


def test_mitsuba_reads_the_ply(tmp_path: Path, mi: Any) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply_with_uv(VERTICES, FACES, NORMALS, UV))
    mesh = mi.traverse(mi.load_dict({"type": "ply", "filename": str(path), "flip_tex_coords": True}))
    np.testing.assert_array_equal(np.array(mesh["vertex_positions"]), VERTICES.ravel())
    np.testing.assert_array_equal(np.array(mesh["faces"]), FACES.ravel())
    np.testing.assert_allclose(np.array(mesh["vertex_normals"]), NORMALS.ravel(), atol=1e-6)
    np.testing.assert_allclose(np.array(mesh["vertex_texcoords"]), UV.ravel(), atol=1e-6)


def test_only_positions_of_a_ply_far_away_are_doubles() -> None:
    far = VERTICES.astype(np.float64) + 45200.123456789
    header, _, body = ply_with_uv(far, FACES, NORMALS, UV).partition(b"end_header\n")
    kinds = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    doubles, floats = [["double", axis] for axis in "xyz"], [["float", name] for name in ("nx", "ny", "nz", "s", "t")]
    assert kinds == [*doubles, *floats, ["list", "uchar", "int", "vertex_indices"]]
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 4\n")
    rows = np.frombuffer(body[: 4 * 44], [("position", "<f8", 3), ("more", "<f4", 5)])
    np.testing.assert_array_equal(rows["position"], far)
    assert len(body) == 4 * 44 + 2 * 13


def loaded(meshes: list[GltfMesh], metres: float | None = None, **extras: Any) -> gltf.GLTF2:
    return gltf.GLTF2.load_from_bytes(glb_bytes(meshes, extras, metres))


def numbers(file: gltf.GLTF2, index: int) -> np.ndarray:
    item = file.accessors[index]
    view = file.bufferViews[item.bufferView]
    assert view.byteOffset % 4 == 0 and item.byteOffset in (0, None)
    kind = {gltf.FLOAT: "<f4", gltf.UNSIGNED_INT: "<u4", gltf.UNSIGNED_SHORT: "<u2"}[item.componentType]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[item.type]
    data = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(data, kind).reshape(item.count, width)


def test_a_glb_has_every_number_of_a_mesh() -> None:
    mesh = GltfMesh("all", VERTICES, FACES, RICH, NORMALS, UV, COLOURS, TANGENTS, extras={"part": "leaf"})
    file = loaded([mesh], prompt="a leaf")
    assert file.asset.version == "2.0" and file.asset.generator == "fd_mitsuba"
    assert file.scene == 0 and file.scenes[0].nodes == [0] and file.scenes[0].extras == {"prompt": "a leaf"}
    node, primitive = file.nodes[0], file.meshes[0].primitives[0]
    assert (node.name, node.mesh, node.extras, file.meshes[0].name) == ("all", 0, {"part": "leaf"}, "all")
    assert node.matrix is None and node.scale is None and primitive.mode == gltf.TRIANGLES
    for key, expected in (
        ("POSITION", VERTICES), ("NORMAL", NORMALS), ("TANGENT", TANGENTS), ("TEXCOORD_0", UV), ("COLOR_0", COLOURS)
    ):  # fmt: skip
        index = getattr(primitive.attributes, key)
        np.testing.assert_array_equal(numbers(file, index), expected)
        assert file.bufferViews[file.accessors[index].bufferView].target == gltf.ARRAY_BUFFER
    place = file.accessors[primitive.attributes.POSITION]
    assert place.min == VERTICES.min(axis=0).tolist() and place.max == VERTICES.max(axis=0).tolist()
    assert file.accessors[primitive.attributes.NORMAL].min in ([], None)
    assert numbers(file, primitive.indices).ravel().tolist() == FACES.ravel().tolist()
    assert file.bufferViews[file.accessors[primitive.indices].bufferView].target == gltf.ELEMENT_ARRAY_BUFFER
    assert file.buffers[0].byteLength == len(file.binary_blob())


def test_a_glb_says_nothing_that_a_mesh_does_not_have() -> None:
    bare = loaded([GltfMesh("bare", VERTICES, FACES, PLAIN, tangents=TANGENTS)])
    attributes = bare.meshes[0].primitives[0].attributes
    for key in ("NORMAL", "TANGENT", "TEXCOORD_0", "COLOR_0"):  # tangents are for a normal map
        assert getattr(attributes, key) is None
    material, surface = bare.materials[0], bare.materials[0].pbrMetallicRoughness
    assert surface.baseColorFactor == [0.4, 0.5, 0.6, 1.0]
    assert (surface.roughnessFactor, surface.metallicFactor) == (0.7, 0.2)
    assert surface.baseColorTexture is surface.metallicRoughnessTexture is material.normalTexture is None
    assert (material.name, material.doubleSided, material.alphaMode) == ("plain", False, "OPAQUE")
    assert material.extensions == {} == material.extras and material.alphaCutoff is None
    assert not bare.extensionsUsed and not bare.images and not bare.textures


def test_a_glb_has_everything_of_a_material() -> None:
    file = loaded([GltfMesh("a", VERTICES, FACES, RICH), GltfMesh("b", VERTICES, FACES, RICH)])
    material, surface = file.materials[0], file.materials[0].pbrMetallicRoughness
    assert surface.baseColorFactor == [0.1, 0.2, 0.3, 0.8]
    assert surface.roughnessFactor == surface.metallicFactor == 1  # the picture has them
    assert (material.name, material.doubleSided, material.alphaMode) == ("rich", True, "BLEND")
    assert material.extras == {"notes": ["no sheen"]}
    assert material.extensions == {
        "KHR_materials_ior": {"ior": 1.33},
        "KHR_materials_specular": {"specularFactor": 0.3},
        "KHR_materials_transmission": {"transmissionFactor": 0.25},
        "KHR_materials_clearcoat": {"clearcoatFactor": 0.4, "clearcoatRoughnessFactor": 0.15},
    }
    assert sorted(file.extensionsUsed) == sorted([*material.extensions, "KHR_texture_transform"])
    repeat = (gltf.REPEAT, gltf.NEAREST, gltf.NEAREST)
    clamp, mirror = (
        (wrap, gltf.LINEAR_MIPMAP_LINEAR, gltf.LINEAR) for wrap in (gltf.CLAMP_TO_EDGE, gltf.MIRRORED_REPEAT)
    )
    transform = {"KHR_texture_transform": {"offset": [0.0, 0.0], "rotation": 0.25, "scale": [2.0, 1.0]}}
    for info, picture, wanted, extensions in (
        (surface.baseColorTexture, BASE, clamp, {}),
        (surface.metallicRoughnessTexture, ROUGH, mirror, transform),
        (material.normalTexture, BUMP, repeat, {}),
    ):
        assert (info.texCoord, info.extensions) == (0, extensions)
        texture = file.textures[info.index]
        sampler, image = file.samplers[texture.sampler], file.images[texture.source]
        assert sampler.wrapS == sampler.wrapT
        assert (sampler.wrapS, sampler.minFilter, sampler.magFilter) == wanted
        view = file.bufferViews[image.bufferView]
        assert (image.name, image.mimeType, view.target) == (picture.name, "image/png", None)
        assert file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength] == picture.data
    assert len(file.textures) == len(file.images) == 3 and len(file.materials) == 2  # the second mesh shares them


def test_how_a_picture_is_looked_up_makes_another_texture() -> None:
    data = b"a picture of an odd length"[:-1]
    looks = [Picture("x", data), Picture("x", data, wrap="clamp"), Picture("x", data, nearest=True)]
    turned = Picture("x", data, rotation=0.5)
    meshes = [
        GltfMesh(str(number), VERTICES, FACES, PbrMaterial("x", base_picture=picture))
        for number, picture in enumerate([*looks, turned])
    ]
    file = loaded(meshes)
    found = [material.pbrMetallicRoughness.baseColorTexture for material in file.materials]
    assert [info.index for info in found] == [0, 1, 2, 0]
    assert len(data) % 4 and not any(view.byteOffset % 4 for view in file.bufferViews)
    transform = {"offset": [0.0, 0.0], "rotation": 0.5, "scale": [1.0, 1.0]}
    assert [info.extensions for info in found] == [{}, {}, {}, {"KHR_texture_transform": transform}]


@pytest.mark.parametrize(
    ("change", "extension"),
    [
        ({"ior": 1.5005}, None), ({"ior": 1.5015}, "KHR_materials_ior"), ({"ior": 1.4985}, "KHR_materials_ior"),
        ({"specular": 0.99}, "KHR_materials_specular"), ({"transmission": 0.01}, "KHR_materials_transmission"),
        ({"clearcoat": 0.01}, "KHR_materials_clearcoat"), ({"clearcoat_roughness": 0.5}, None),
    ],
)  # fmt: skip
def test_an_extension_only_for_what_differs_from_its_default(change: dict[str, float], extension: str | None) -> None:
    file = loaded([GltfMesh("x", VERTICES, FACES, PbrMaterial("x", **change))])  # type: ignore[arg-type]
    assert list(file.materials[0].extensions) == list(file.extensionsUsed) == ([extension] if extension else [])


def test_nodes_hang_where_they_belong() -> None:
    place = np.array([[1.0, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12], [0, 0, 0, 1]])
    meshes = [
        GltfMesh("a", VERTICES, FACES, PLAIN, to_world=place, parent="pair"),
        GltfMesh("b", VERTICES, FACES, PLAIN, parent="pair"),
        GltfMesh("c", VERTICES, FACES, PLAIN),
        GltfMesh("d", VERTICES, FACES, PLAIN, parent="other"),
    ]

    def tree(file: gltf.GLTF2, node: int) -> Any:
        item = file.nodes[node]
        return {item.name: [tree(file, child) for child in item.children]} if item.mesh is None else item.name

    flat = loaded(meshes)
    expected = [{"pair": ["a", "b"]}, "c", {"other": ["d"]}]
    assert [tree(flat, node) for node in flat.scenes[0].nodes] == expected
    assert flat.nodes[0].matrix == place.T.ravel().tolist() and flat.nodes[2].matrix is None
    assert ROOT_NAME == "asset"
    for metres, scale in ((1.0, None), (0.01, [0.01] * 3)):
        file = loaded(meshes, metres)
        (root,) = file.scenes[0].nodes
        assert tree(file, root) == {ROOT_NAME: expected} and file.nodes[root].scale == scale


@pytest.mark.parametrize(("count", "component"), [(65534, gltf.UNSIGNED_SHORT), (65535, gltf.UNSIGNED_INT)])
def test_indices_are_as_short_as_they_can_be(count: int, component: int) -> None:
    """65535, the largest of 16 bits, is no index."""
    faces = np.array([[0, 1, count - 1]])
    file = loaded([GltfMesh("x", np.zeros((count, 3)), faces, PLAIN)])
    index = file.meshes[0].primitives[0].indices
    assert file.accessors[index].componentType == component
    assert numbers(file, index).ravel().tolist() == faces.ravel().tolist()


def test_a_node_cannot_be_sheared() -> None:
    turned = np.array([[0.0, -2, 0, 5], [1, 0, 0, 0], [0, 0, -3, 1], [0, 0, 0, 1]])
    assert is_placement(turned) and is_placement(1e-6 * turned) and is_placement(1e6 * turned)
    turned[0, 0] = 0.01
    assert not is_placement(turned) and not is_placement(1e-6 * turned)
