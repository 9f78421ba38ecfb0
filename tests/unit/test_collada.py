"""COLLADA files: written by pycollada, read into assets, compared with what was written and with trimesh's reader."""

from __future__ import annotations

import re
from pathlib import Path

import collada
import numpy as np
import pytest
import trimesh
from PIL import Image

from fd_mitsuba.assets.asset import Asset
from fd_mitsuba.assets.images import pixels
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.srgb import linear_from_srgb

pytestmark = pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # of pycollada's, as it writes
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype=np.float32)
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
MOVE = np.array([[0, 0, 2, 5], [2, 0, 0, 0], [0, 2, 0, -1], [0, 0, 0, 1]], dtype=np.float64)


def write(folder: Path, image: str = "tiles.png", up: str = "Z_UP", unit: float = 0.01) -> Path:
    """A box of quads with UVs and an image, moved by its node, and a red triangle."""
    document = collada.Collada()
    document.assetInfo.upaxis, document.assetInfo.unitmeter, document.assetInfo.unitname = up, unit, "unit"
    surface = collada.material.CImage("picture", image)
    sampler = collada.material.Sampler2D("sampler", collada.material.Surface("surface", surface))
    effects = [
        collada.material.Effect(
            "tiles", [sampler.surface, sampler], "phong", diffuse=collada.material.Map(sampler, "UVSET0")
        ),
        collada.material.Effect("paint", [], "lambert", diffuse=(1.0, 0.5, 0.0, 1.0), double_sided=True),
    ]
    document.images.append(surface)
    nodes = []
    for number, effect in enumerate(effects):
        document.effects.append(effect)
        material = collada.material.Material(f"material{number}", f"material{number}", effect)
        document.materials.append(material)
        sources = [collada.source.FloatSource("places", CUBE.ravel(), ("X", "Y", "Z"))]
        inputs = collada.source.InputList()
        inputs.addInput(0, "VERTEX", "#places")
        if number == 0:
            corners = np.array([[0, 0], [1, 0], [1, 0.25], [0, 0.25]], dtype=np.float32)
            sources.append(collada.source.FloatSource("corners", corners.ravel(), ("S", "T")))
            inputs.addInput(1, "TEXCOORD", "#corners", set="0")
        geometry = collada.geometry.Geometry(document, f"mesh{number}", f"mesh{number}", sources)
        if number == 0:
            index = np.array([[v, k] for quad in QUADS for k, v in enumerate(quad)])
            primitive = geometry.createPolylist(index.ravel(), np.full(6, 4), inputs, "symbol")
        else:
            primitive = geometry.createTriangleSet(np.array([0, 1, 2]), inputs, "symbol")
        geometry.primitives.append(primitive)
        document.geometries.append(geometry)
        link = collada.scene.MaterialNode("symbol", material, inputs=[])
        place = [collada.scene.MatrixTransform(MOVE.astype(np.float32).ravel())] if number == 0 else []
        nodes.append(
            collada.scene.Node(
                f"node{number}", children=[collada.scene.GeometryNode(geometry, [link])], transforms=place
            )
        )
    scene = collada.scene.Scene("scene", nodes)
    document.scenes.append(scene)
    document.scene = scene
    path = folder / "box.dae"
    with path.open("wb") as file:
        document.write(file)
    return path


@pytest.fixture
def picture(tmp_path: Path) -> np.ndarray:
    rows = np.linspace(0, 255, 8).astype(np.uint8)
    values = np.stack([np.tile(rows[:, None], (1, 8))] * 3, axis=-1)
    Image.fromarray(values).save(tmp_path / "tiles.png")
    return values


def test_what_was_written_is_read(tmp_path: Path, picture: np.ndarray) -> None:
    asset = read_asset(write(tmp_path))
    assert (asset.up, asset.unit, asset.notes) == ("+z", "cm", ())
    box, triangle = asset.meshes
    vertices, faces, _ = box.placed()
    assert len(faces) == 12 and len(triangle.faces) == 1
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert np.allclose(low, [5, 0, -1]) and np.allclose(high, [11, 2, 3])
    solid = trimesh.Trimesh(vertices, faces)  # corners are welded by it
    assert solid.is_watertight and solid.volume == pytest.approx(2**3 * 6)
    tiles, paint = (asset.materials[mesh.material] for mesh in asset.meshes)
    assert paint.base_color == pytest.approx(tuple(linear_from_srgb(np.array([1.0, 0.5, 0.0])))) and paint.double_sided
    assert tiles.base_texture is not None and np.array_equal(pixels(tiles.base_texture.image), picture)
    # T runs upwards in COLLADA: the lowest quarter of the image is its last rows.
    assert box.uvs[0][:, 1].min() == pytest.approx(0.75) and box.uvs[0][:, 1].max() == pytest.approx(1.0)


def test_positions_and_uvs_are_those_of_another_reader(tmp_path: Path, picture: np.ndarray) -> None:
    path = write(tmp_path)
    theirs = trimesh.load(path, force="mesh", process=False)
    assert isinstance(theirs, trimesh.Trimesh)
    ours = soup(read_asset(path))
    assert ours.shape == theirs.triangles.shape
    flat = [np.sort(corners.reshape(-1, 9), axis=0) for corners in (ours, theirs.triangles)]
    assert np.allclose(*flat, atol=1e-5)


def soup(asset: Asset) -> np.ndarray:
    return np.concatenate([vertices[faces] for vertices, faces, _ in (mesh.placed() for mesh in asset.meshes)])


def test_an_image_that_is_not_there_is_a_note(tmp_path: Path) -> None:
    asset = read_asset(write(tmp_path, image="C:/maker/tiles.png"))
    assert asset.materials[0].base_texture is None
    assert asset.notes == (
        "material 'material0': its image 'C:/maker/tiles.png' is not beside the file and is left out",
    )


def test_an_image_is_found_by_its_last_name(tmp_path: Path, picture: np.ndarray) -> None:
    assert read_asset(write(tmp_path, image="file:///C:/maker/tiles.png")).materials[0].base_texture is not None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: "<!DOCTYPE a [<!ENTITY b 'c'>]>" + text, "declares a document type"),
        (lambda text: text[: len(text) // 2], "cannot be read"),
        (lambda text: text.replace("<instance_geometry", "<x").replace("</instance_geometry", "</x"), "no faces"),
        (lambda text: "", "is empty"),
        (lambda text: re.sub(r"(<float_array[^>]*places[^>]*>)[^ ]+", r"\1NaN", text), "NaN or infinite"),
        (lambda text: "\0\0" + text, "is not UTF-8"),
    ],
)
def test_broken_files_are_one_line(tmp_path: Path, picture: np.ndarray, change: object, said: str) -> None:
    path = write(tmp_path)
    text = path.read_text()
    path.write_text(change(text[text.index("<COLLADA") :]))  # type: ignore[operator]
    with pytest.raises(UserError) as caught:
        read_asset(path)
    assert said in str(caught.value) and "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_another_unit_is_asked_for(tmp_path: Path, picture: np.ndarray) -> None:
    asset = read_asset(write(tmp_path, up="Y_UP", unit=0.0254))
    assert asset.unit is None and asset.up == "+y"
    assert asset.notes == ("its unit of 0.0254 m is none of mm, cm, m; say what it is by --units",)
