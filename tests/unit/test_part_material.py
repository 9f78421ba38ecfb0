from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.part_material import PartMaterial, part_material

Make = Callable[..., Path]
ALL = ("base_color", "roughness", "metallic", "normal")


def material_of(make_scene: Make, part: str, **options: Any) -> PartMaterial:
    return part_material(load_edit_scene(make_scene(part=part)), **options)


def bsdf(kind: str, inner: str = "", name: str = ' id="part"') -> str:
    return f'<bsdf type="{kind}"{name}>{inner}</bsdf>'


def nested(kind: str, inner: str, rest: str = "") -> str:
    return bsdf(kind, rest + inner.replace(' id="part"', ""))


def texture_of(mi: Any, *values: float) -> Any:
    data = np.broadcast_to(np.array(values, dtype=np.float32), (2, 3, len(values)))
    return mi.load_dict({"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(data)), "raw": True})


def loaded(mi: Any, material: PartMaterial, values: dict[str, tuple[float, ...]]) -> Any:
    """The BSDF with a constant picture for each channel of `values`."""
    description = copy.deepcopy(material.description)
    for channel, value in values.items():
        *nested_in, parameter = material.feeds[channel].split(".")
        target = description
        for key in nested_in:
            target = target[key]
        target[parameter] = texture_of(mi, *value)
    return mi.load_dict(description)


# name: (BSDF, learned, parameters fed, squared, start colour, start roughness)
KINDS = {
    "principled": (
        bsdf("principled", '<rgb name="base_color" value="0.8, 0.78, 0.74"/><float name="roughness" value="0.6"/>'),
        ALL, ("base_color", "roughness", "metallic"), "", (0.8, 0.78, 0.74), 0.6),
    "missing": ("", ALL, ("base_color", "roughness", "metallic"), "", (0.5, 0.5, 0.5), 0.5),
    "diffuse": (bsdf("diffuse"), ("base_color", "normal"), ("reflectance",), "", (0.5, 0.5, 0.5), 1.0),
    "plastic": (bsdf("plastic"), ("base_color", "normal"), ("diffuse_reflectance",), "", (0.5, 0.5, 0.5), 0.0),
    "roughplastic": (
        bsdf("roughplastic",
             '<float name="alpha" value="0.16"/><rgb name="diffuse_reflectance" value="0.2, 0.3, 0.4"/>'),
        ("base_color", "normal"), ("diffuse_reflectance",), "", (0.2, 0.3, 0.4), 0.4),
    "roughconductor": (
        bsdf("roughconductor", '<string name="material" value="Au"/><float name="alpha" value="0.04"/>'),
        ("base_color", "roughness", "normal"), ("specular_reflectance", "alpha"), "roughness", (1, 1, 1), 0.2),
    "conductor": (
        bsdf("conductor", '<rgb name="specular_reflectance" value="0.9, 0.5, 0.2"/>'),
        ("base_color", "normal"), ("specular_reflectance",), "", (0.9, 0.5, 0.2), 0.0),
    "roughdielectric": (bsdf("roughdielectric"), ("roughness", "normal"), ("alpha",), "roughness", None, None),
    "principledthin": (
        bsdf("principledthin"), ("base_color", "roughness", "normal"), ("base_color", "roughness"), "",
        (0.5, 0.5, 0.5), 0.5),
    "pplastic": (
        bsdf("pplastic", '<float name="alpha" value="0.04"/>'), ("base_color", "roughness", "normal"),
        ("diffuse_reflectance", "alpha"), "roughness", (0.5, 0.5, 0.5), 0.2),
    "twosided": (
        nested("twosided", bsdf("principled", '<float name="metallic" value="1"/>')),
        ALL, ("nested_0.base_color", "nested_0.roughness", "nested_0.metallic"), "", (0.5, 0.5, 0.5), 0.5),
    "mask": (
        nested("mask", nested("twosided", bsdf("diffuse")), '<float name="opacity" value="0.5"/>'),
        ("base_color", "normal"), ("nested_0.nested_0.reflectance",), "", (0.5, 0.5, 0.5), 1.0),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_what_is_learned(make_scene: Make, mi: Any, name: str) -> None:
    part, learned, parameters, squared, colour, roughness = KINDS[name]
    material = material_of(make_scene, part)
    assert material.learned == learned and tuple(material.feeds.values()) == parameters
    assert material.squared == frozenset([squared] if squared else [])
    if colour is not None:
        assert material.start.base_color == pytest.approx(colour, abs=1e-5)
        assert material.start.roughness == pytest.approx(roughness, abs=1e-5)
    assert "\n" not in material.message and all(channel in material.message for channel in learned)
    # A renderer that puts its textures where the paths say gets a BSDF that reads them.
    given = {"base_color": (0.2, 0.3, 0.4), "roughness": (0.3,), "metallic": (0.7,)}
    built = mi.traverse(loaded(mi, material, {channel: given[channel] for channel in material.feeds}))
    for channel, path in material.feeds.items():
        (key,) = (key for key in built.keys() if key.endswith(f"{path.rpartition('.')[2]}.data"))
        assert np.allclose(np.array(built[key])[0, 0], given[channel])
    assert not [key for key in mi.traverse(mi.load_dict(material.description)).keys() if key.endswith(".data")]


def test_what_the_file_says_besides_stays(make_scene: Make, mi: Any) -> None:
    inner = (
        '<float name="specular" value="0.3"/><float name="clearcoat" value="0.8"/><float name="roughness" value="0.3"/>'
    )
    material = material_of(make_scene, bsdf("principled", inner))
    built = mi.traverse(loaded(mi, material, {"base_color": (0.1, 0.2, 0.3)}))
    for key, value in (("clearcoat.value", 0.8), ("roughness.value", 0.3)):
        assert np.allclose(np.array(built[key]), value)


def test_textures_shade_as_constants_do(make_scene: Make, mi: Any) -> None:
    """The BSDF with textures has the values of one that was loaded with the same constants."""
    material = material_of(make_scene, KINDS["roughconductor"][0])
    ours = loaded(mi, material, {"base_color": (0.5, 0.6, 0.7), "roughness": (0.09,)})
    theirs = mi.load_dict(
        {"type": "roughconductor", "material": "Au", "alpha": 0.09,
         "specular_reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}}
    )  # fmt: skip
    si = dr.zeros(mi.SurfaceInteraction3f, 5)
    si.wi = dr.normalize(mi.Vector3f([0.1, 0.2, 0.3, 0.4, 0.5], 0.1, 1.0))
    wo = dr.normalize(mi.Vector3f(-0.2, 0.1, 1.0))
    values = [np.array(bsdf.eval(mi.BSDFContext(), si, wo)) for bsdf in (ours, theirs)]
    assert values[0].max() > 0.1 and np.allclose(values[0], values[1], rtol=1e-5)


def test_a_texture_fixes_its_parameter(make_scene: Make) -> None:
    inner = '<texture type="uniform" name="metallic"><float name="value" value="0.25"/></texture>'
    material = material_of(make_scene, bsdf("principled", inner))
    assert material.learned == ("base_color", "roughness", "normal")
    assert material.start.metallic == 0.25 and "fixed: metallic" in material.message


def test_settings_fix_channels(make_scene: Make) -> None:
    material = material_of(make_scene, "", fixed=["metallic", "roughness"], normal_map=False)
    assert material.learned == ("base_color",) and list(material.feeds) == ["base_color"]
    assert "fixed: roughness, metallic, normal" in material.message
    assert material_of(make_scene, "", fixed=["normal"]).learned == ALL[:3]


def test_says_what_cannot_vary(make_scene: Make) -> None:
    message = material_of(make_scene, KINDS["roughplastic"][0]).message
    assert "roughplastic learns base_color (diffuse_reflectance), normal" in message
    assert "cannot vary over its surface: roughness, metallic" in message


UNIFORM = '<texture type="uniform" name="{}"><float name="value" value="0.25"/></texture>'
VARYING = '<texture type="checkerboard" name="{}"/>'
BAD = {
    "dielectric": (bsdf("dielectric"), ("dielectric", "nothing to learn", "principled")),
    "null": (bsdf("null"), ("null", "nothing to learn")),
    "blend": (
        nested("blendbsdf", bsdf("diffuse") + bsdf("plastic"), '<float name="weight" value="0.5"/>'),
        ("blendbsdf", "2 BSDFs", "use one"),
    ),
    "varying colour": (bsdf("diffuse", VARYING.format("reflectance")), ("reflectance", "no UVs", "constant")),
    "varying rest": (bsdf("principled", VARYING.format("clearcoat")), ("clearcoat", "no UVs")),
    "varying normal": (
        nested("bumpmap", bsdf("principled"), VARYING.format("bump")), ("nested_texture", "no UVs")
    ),
    "everything fixed": (bsdf("diffuse", UNIFORM.format("reflectance")), ("nothing to learn", "fixed: base_color")),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_part_in_one_line(make_scene: Make, name: str) -> None:
    part, words = BAD[name]
    with pytest.raises(UserError) as caught:
        material_of(make_scene, part)
    message = str(caught.value)
    assert "\n" not in message and "scene.xml:" in message and 'id="part"' in message
    for word in words:
        assert word in message, message


def test_a_custom_bsdf_learns_what_it_has(make_scene: Make, mi: Any) -> None:
    class Velvet(mi.BSDF):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.colour = properties.get_texture("base_color", 0.4)
            self.m_components, self.m_flags = [mi.BSDFFlags.DiffuseReflection], mi.BSDFFlags.DiffuseReflection

        def traverse(self, callback: Any) -> None:
            callback.put("base_color", self.colour, mi.ParamFlags.Differentiable)

    mi.register_bsdf("test_velvet", lambda properties: Velvet(properties))
    material = material_of(make_scene, bsdf("test_velvet"))
    assert material.learned == ("base_color", "normal") and material.feeds == {"base_color": "base_color"}
    assert material.start.base_color == pytest.approx((0.4, 0.4, 0.4))
    assert "test_velvet learns base_color, normal" in material.message


def test_a_part_given_by_reference(make_scene: Make) -> None:
    wrapped = '<bsdf type="diffuse" id="paint"/><bsdf type="twosided" id="part"><ref id="paint"/></bsdf>'
    assert list(material_of(make_scene, wrapped).feeds) == ["base_color"]
