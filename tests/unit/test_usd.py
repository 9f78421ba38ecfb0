"""The format `usdz`, read back by Pixar's own library: numbers, pictures, materials, and its rules for packages."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fd_mitsuba as fd
from fd_mitsuba.assets.readers import read_asset
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.export import usd
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.tessellate import unit_sphere

pytest.importorskip("pxr")
from pxr import Usd, UsdGeom, UsdShade, UsdValidation  # noqa: E402

ASSETS = Path(__file__).parents[1] / "data" / "assets"
BALL, FACES = unit_sphere(2)
Export = Callable[..., Path]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, mi: Any) -> Export:
    """The package of an asset with a ball as its part; each once."""
    made: dict[str, Path] = {}

    def export(name: str, **options: Any) -> Path:
        key = f"{name} {options}"
        if key not in made:
            folder = tmp_path_factory.mktemp("usd")
            imported = fd.import_asset(ASSETS / name, folder / "scene", prompt="a thing with a hat", up="y", front="z")
            scene = load_edit_scene(imported.scene)
            part = {"part": PartAsset(0.1 * BALL + scene.frame.to_user(scene.regions[0].centre), FACES)}
            export_assets(scene, RunConfig(), part, folder, ["glb", Choice.of("usdz", options)], 64)
            made[key] = folder / "usd" / "asset.usdz"
        return made[key]

    return export


def meshes(path: Path) -> dict[str, Any]:
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    found = {prim.GetName(): UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
    return {"stage": stage, **found}


@pytest.mark.parametrize("name", ["figure.glb", "maps.glb", "mask.glb", "transformed_uv.glb", "colours.glb"])
def test_pixars_own_validators_find_nothing(exported: Export, name: str) -> None:
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    stage = Usd.Stage.Open(str(exported(name)))
    assert [f"{error.GetName()}: {error.GetMessage()}" for error in context.Validate(stage)] == []


def test_numbers_are_those_of_the_glb(exported: Export) -> None:
    path = exported("figure.glb")
    found, glb = meshes(path), read_asset(path.parents[1] / "asset.glb")
    assert UsdGeom.GetStageMetersPerUnit(found["stage"]) == 1
    assert set(found) == {"stage", "base_red", "base_gold", "part_part"}
    for mesh in glb.meshes:
        prim = found[mesh.name]
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim.GetPrim())).T
        points = np.array(prim.GetPointsAttr().Get()) @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.allclose(points, mesh.placed()[0], atol=1e-6)
        assert np.array_equal(np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), mesh.faces)


def test_unit_is_that_of_the_scene_or_as_told(exported: Export) -> None:
    assert UsdGeom.GetStageMetersPerUnit(meshes(exported("maps.glb", unit="cm"))["stage"]) == 0.01


def looked_up(prim: Any, wanted: str) -> tuple[Any, str]:
    """The node behind an input of a mesh's surface, and which of its outputs."""
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    surface = material.ComputeSurfaceSource()[0]
    source = surface.GetInput(wanted).GetConnectedSources()[0][0]
    return UsdShade.Shader(source.source.GetPrim()), source.sourceName


def test_textures_are_the_assets_own_and_meet_the_same_places(exported: Export) -> None:
    path = exported("transformed_uv.glb")
    found = meshes(path)  # its prims live as long as its stage
    prim = found["base"]
    node, output = looked_up(prim, "diffuseColor")
    assert output == "rgb" and node.GetInput("sourceColorSpace").Get() == "sRGB"
    name = node.GetInput("file").Get().path
    before = read_asset(ASSETS / "transformed_uv.glb").materials[0].base_texture
    assert before is not None
    assert zipfile.ZipFile(path).read(name) == before.image.data
    turned = UsdShade.Shader(node.GetInput("st").GetConnectedSources()[0][0].source.GetPrim())
    scale, move = (np.array(turned.GetInput(key).Get(), float) for key in ("scale", "translation"))
    angle = np.radians(turned.GetInput("rotation").Get())
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    below = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get(), float)  # v upwards, before and after
    place = below * scale @ turn.T + move
    uv = np.stack([below[:, 0], 1 - below[:, 1], np.ones(len(below))], axis=1)
    expected = (uv @ before.to_uv.T)[:, :2]
    assert np.allclose(place, np.stack([expected[:, 0], 1 - expected[:, 1]], axis=1), atol=1e-5)


def test_channels_of_maps_and_alpha(exported: Export) -> None:
    found = [meshes(exported(name)) for name in ("maps.glb", "mask.glb", "colours.glb")]
    prim, masked, tinted = (stage["base"] for stage in found)
    (rough, green), (metal, blue), (bent, _) = (looked_up(prim, key) for key in ("roughness", "metallic", "normal"))
    assert (green, blue) == ("g", "b") and rough.GetPath() == metal.GetPath()
    assert rough.GetInput("sourceColorSpace").Get() == "raw"
    assert tuple(bent.GetInput("scale").Get())[:3] == (2, 2, 2) and tuple(bent.GetInput("bias").Get())[:3] == (-1,) * 3
    assert looked_up(masked, "opacity")[1] == "a"
    assert looked_up(tinted, "diffuseColor")[0].GetInput("varname").Get() == "displayColor"


def test_what_lies_in_the_package_is_aligned_and_the_same_each_time(exported: Export) -> None:
    path = exported("maps.glb")
    data = path.read_bytes()
    for entry in zipfile.ZipFile(path).infolist():
        head = data[entry.header_offset : entry.header_offset + 30]
        start = entry.header_offset + 30 + int.from_bytes(head[26:28], "little") + int.from_bytes(head[28:30], "little")
        assert start % 64 == 0 and entry.compress_type == zipfile.ZIP_STORED and start + entry.file_size <= len(data)
    assert usd._package({"a.usdc": b"1", "b.png": b"2"}) == usd._package({"a.usdc": b"1", "b.png": b"2"})


def test_without_the_library_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usd.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'fd_mitsuba\[usd\]'"):
        usd.Usdz(usd.UsdzSettings()).write(None)  # type: ignore[arg-type]
