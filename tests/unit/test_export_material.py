"""BSDFs as metallic-roughness materials."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fd_mitsuba.export.material import PbrMaterial, pbr_material
from fd_mitsuba.scene.scene_file import SceneFile

Make = Callable[..., Path]


@pytest.fixture
def material_of(make_scene: Make) -> Callable[[str], PbrMaterial]:
    def read(bsdf: str) -> PbrMaterial:
        file = SceneFile(make_scene(part=bsdf.replace(">", ' id="part">', 1)))
        element = next(element for element in file.top_level("bsdf") if element.id == "part")
        return pbr_material(file, element, "m")

    return read


def test_principled_is_taken_over(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of(
        '<bsdf type="principled"><rgb name="base_color" value="0.1, 0.2, 0.3"/><float name="roughness" value="0.25"/>'
        '<float name="metallic" value="0.75"/><float name="specular" value="0.5"/></bsdf>'
    )
    assert made.base_color == pytest.approx((0.1, 0.2, 0.3), abs=1e-6)
    assert (made.roughness, made.metallic) == pytest.approx((0.25, 0.75), abs=1e-6)
    assert made.ior == pytest.approx(1.5, abs=1e-6) and made.notes == ()  # glTF's own reflectance of 0.04


def test_diffuse_has_no_highlight(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of('<bsdf type="diffuse"><spectrum name="reflectance" value="0.3"/></bsdf>')
    assert made.base_color == pytest.approx((0.3, 0.3, 0.3), abs=1e-6)
    assert (made.roughness, made.metallic, made.specular) == (1.0, 0.0, 0.0)


def test_gold_is_a_rough_metal(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of(
        '<bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0.09"/></bsdf>'
    )
    assert (made.roughness, made.metallic) == pytest.approx((0.3, 1.0), abs=1e-6)
    assert made.base_color == pytest.approx((0.967, 0.802, 0.324), abs=0.02)  # Mitsuba's conductor, seen head on
    assert made.notes == ("nearest to Mitsuba's roughconductor",)


def test_plastic_and_glass(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of(
        '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.5, 0.1, 0.1"/>'
        '<float name="alpha" value="0.04"/></bsdf>'
    )
    assert made.base_color == pytest.approx((0.5, 0.1, 0.1), abs=1e-6) and made.roughness == pytest.approx(0.2)
    glass = material_of('<bsdf type="dielectric"><float name="int_ior" value="1.6"/></bsdf>')
    assert (glass.transmission, glass.ior, glass.roughness) == pytest.approx((1.0, 1.6, 0.0), abs=1e-6)


def test_wrappers_are_looked_through(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of(
        '<bsdf type="mask"><float name="opacity" value="0.4"/><bsdf type="twosided"><bsdf type="principled">'
        '<float name="roughness" value="0.9"/></bsdf></bsdf></bsdf>'
    )
    assert made.double_sided and made.opacity == pytest.approx(0.4) and made.roughness == pytest.approx(0.9)


def test_textures(material_of: Callable[[str], PbrMaterial], tmp_path: Path) -> None:
    Image.fromarray(np.full((4, 4, 3), (200, 100, 50), dtype=np.uint8)).save(tmp_path / "paint.png")
    Image.fromarray(np.full((8, 8), 51, dtype=np.uint8)).save(tmp_path / "rough.png")
    bitmap = '<texture type="bitmap" name="{}"><string name="filename" value="{}"/><boolean name="raw" value="{}"/>{}'
    tiled = '<transform name="to_uv"><scale x="2" y="3"/></transform></texture>'
    made = material_of(
        '<bsdf type="principled">'
        + bitmap.format("base_color", "paint.png", "false", tiled)
        + bitmap.format("roughness", "rough.png", "true", "</texture>")
        + '<float name="metallic" value="0.4"/></bsdf>'
    )
    assert made.base_picture is not None and made.base_picture.data == (tmp_path / "paint.png").read_bytes()
    assert made.base_picture.tiling == ((0.0, 0.0), (2.0, 3.0)) and made.base_color == (1.0, 1.0, 1.0)
    assert made.orm_picture is not None and made.orm_picture.pixels().shape == (8, 8, 3)
    assert np.all(made.orm_picture.pixels() == (255, 51, 102))
    raw = material_of('<bsdf type="diffuse">' + bitmap.format("reflectance", "paint.png", "true", "</texture></bsdf>"))
    assert raw.base_picture is not None and "converted" in raw.notes[0]
    # Read as linear by Mitsuba, so 200/255 must look like 200/255 linear in sRGB.
    assert abs(int(raw.base_picture.pixels()[0, 0, 0]) - 255 * (1.055 * (200 / 255) ** (1 / 2.4) - 0.055)) <= 1


def test_vertex_colours(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of(
        '<bsdf type="principled"><texture type="mesh_attribute" name="base_color">'
        '<string name="name" value="vertex_color"/></texture></bsdf>'
    )
    assert made.colours == "vertex_color" and made.base_color == (1.0, 1.0, 1.0)


def test_what_is_lost_is_said(material_of: Callable[[str], PbrMaterial]) -> None:
    made = material_of('<bsdf type="principled"><float name="sheen" value="1"/></bsdf>')
    assert made.notes == ("without sheen",)
