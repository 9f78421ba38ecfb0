"""Bad input that only the appearance stage minds, or that it must not mind: one clear line each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import BASE, LIGHT
from PIL import Image

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.appearance_inputs import check_appearance_inputs
from fd_mitsuba.scene.load_scene import load_edit_scene

Make = Callable[..., Path]
SKY = '<emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/>{}</emitter>'
AREA = """<shape type="rectangle" id="lamp"><transform name="to_world"><translate z="9"/></transform>
    <emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>"""


def base(bsdf: str) -> str:
    return BASE.replace('<bsdf type="diffuse"/>', bsdf)


def texture(name: str, file: str = "paint.png") -> str:
    return f'<texture type="bitmap" name="{name}"><string name="filename" value="{file}"/></texture>'


def picture(path: Path, mi: Any, values: np.ndarray) -> None:
    with file_threads():
        mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)).write(str(path))


def sky(change: Callable[[np.ndarray], None] = lambda values: None) -> np.ndarray:
    values = np.ones((8, 16, 3), dtype=np.float32)
    change(values)
    return values


def message_of(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        check_appearance_inputs(load_edit_scene(path))
    message = str(caught.value)
    assert "\n" not in message and ".cpp" not in message and str(path) in message and len(message) < 400
    print(message)
    return message


# name: (pieces of the scene, words of the message)
CASES = {
    "no emitter": ({"light": ""}, ("no emitter", "add")),
    "bitmap without UVs": (
        {"base": base(f'<bsdf type="diffuse">{texture("reflectance")}</bsdf>')},
        ("body", "paint.png", "UVs", "unwrap"),
    ),
    "wrapped bitmap without UVs": (
        {"base": base(f'<bsdf type="twosided"><bsdf type="principled">{texture("roughness")}</bsdf></bsdf>')},
        ("body", "UVs"),
    ),
    "checkerboard without UVs": (
        {"base": base('<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"/></bsdf>')},
        ("body", "checkerboard", "UVs"),
    ),
    "missing texture": (
        {"base": base(f'<bsdf type="diffuse">{texture("reflectance", "gone.png")}</bsdf>')},
        ("bitmap", "gone.png", "not found"),
    ),
    "texture that is no picture": (
        {"base": base(f'<bsdf type="diffuse">{texture("reflectance", "scene.xml")}</bsdf>')},
        ("scene.xml",),
    ),
    "attribute that the mesh lacks": (
        {
            "base": base(
                '<bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance">'
                '<string name="name" value="vertex_color"/></texture></bsdf>'
            )
        },
        ("body", "vertex_color", "none", "save the mesh"),
    ),
    "negative scale": ({"light": SKY.format('<float name="scale" value="-1"/>')}, ("sky", "scale", "positive")),
    "scale NaN": ({"light": SKY.format('<float name="scale" value="nan"/>')}, ("sky", "scale")),
    "roughness of the base": (
        {"base": base('<bsdf type="principled"><float name="roughness" value="7"/></bsdf>')},
        ("principled", "roughness is 7", "between 0 and 1"),
    ),
    "colour of the part": (
        {"part": '<bsdf type="principled" id="part"><rgb name="base_color" value="0.5, -2, 0.5"/></bsdf>'},
        ("part", "[0.5, -2, 0.5]", "[0, 1]"),
    ),
    "metallic NaN": (
        {"part": '<bsdf type="principled" id="part"><float name="metallic" value="nan"/></bsdf>'},
        ("part", "metallic holds NaN"),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_bad_input(make_scene: Make, tmp_path: Path, mi: Any, name: str) -> None:
    pieces, words = CASES[name]
    Image.fromarray(np.full((4, 4, 3), 99, dtype=np.uint8)).save(tmp_path / "paint.png")
    picture(tmp_path / "sky.exr", mi, sky())
    message = message_of(make_scene(**pieces))
    for word in words:
        assert word in message, message


def _nan(values: np.ndarray) -> None:
    values[2, 3] = np.nan


def _infinite(values: np.ndarray) -> None:
    values[2, 3, 1] = np.inf


def _negative(values: np.ndarray) -> None:
    values[2, 3, 1] = -0.25


def _black(values: np.ndarray) -> None:
    values[:] = 0


@pytest.mark.parametrize(
    ("change", "words"),
    [(_nan, "NaN or infinity (3 of 384"), (_infinite, "NaN or infinity (1 of 384"), (_black, "is black")],
)  # fmt: skip
def test_bad_light(make_scene: Make, tmp_path: Path, mi: Any, change: Callable, words: str) -> None:
    picture(tmp_path / "sky.exr", mi, sky(change))
    message = message_of(make_scene(light=SKY.format("")))
    assert words in message and "sky" in message and "sky.exr" in message


def test_negative_light_is_a_warning(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    picture(tmp_path / "sky.exr", mi, sky(_negative))
    (warning,) = check_appearance_inputs(load_edit_scene(make_scene(light=SKY.format(""))))
    assert "sky.exr" in warning and "down to -0.25" in warning and "clamp" in warning


def test_texture_that_is_not_finite(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    picture(tmp_path / "paint.exr", mi, sky(_nan))
    paint = texture("reflectance", "paint.exr")
    small = '<float name="radius" value="0.3"/>'
    ball = f'<shape type="sphere" id="body">{small}<bsdf type="diffuse">{paint}</bsdf></shape>'
    assert "paint.exr holds NaN" in message_of(make_scene(base=ball))


def test_truncated_texture(make_scene: Make, tmp_path: Path) -> None:
    path = tmp_path / "paint.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:200])
    scene = make_scene(base=base(f'<bsdf type="diffuse">{texture("reflectance")}</bsdf>'))
    with pytest.raises(UserError, match=r"paint\.png"):
        check_appearance_inputs(load_edit_scene(scene))


@pytest.mark.parametrize(
    ("override", "words"),
    [("texture.base_color_range=[0.9, 0.1]", "base_color_range"), ("texture.roughness_range=[0, 3]", "roughness_range"),
     ("texture.metallic_range=[-1, 1]", "metallic_range"), ("texture.max_tilt_deg=90", "max_tilt_deg"),
     ("texture.base_color_range=[nan, 1]", "base_color_range"), ("texture.finest_resolution=2", "finest_resolution"),
     ("appearance.timestep_range=[0.9, 0.1]", "timestep_range"), ("appearance.max_depth=1", "max_depth"),
     ("appearance.background=blue", "background"), ("appearance.fixed=[\"gloss\"]", "fixed"),
     ("appearance.exposure=0", "exposure"), ("appearance.learning_rate=-1", "learning_rate")],
)  # fmt: skip
def test_absurd_settings(override: str, words: str) -> None:
    with pytest.raises(UserError) as caught:
        RunConfig.load(None, [override])
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_good_scenes_pass(make_scene: Make, tmp_path: Path, mi: Any) -> None:
    """8-bit textures are fine, and so is a shape that brings its own UVs."""
    Image.fromarray(np.full((4, 4, 3), 99, dtype=np.uint8)).save(tmp_path / "paint.png")
    picture(tmp_path / "sky.exr", mi, sky())
    assert check_appearance_inputs(load_edit_scene(make_scene())) == ()
    assert check_appearance_inputs(load_edit_scene(make_scene(light=SKY.format("")))) == ()
    ball = f'<shape type="sphere" id="body"><bsdf type="diffuse">{texture("reflectance")}</bsdf></shape>'
    check_appearance_inputs(load_edit_scene(make_scene(base=ball, part="")))


def test_area_lights_are_light_and_not_base(make_scene: Make) -> None:
    scene = load_edit_scene(make_scene(light=AREA))
    assert [mesh.name for mesh in scene.base] == ["body"] and scene.has_light
    plain = load_edit_scene(make_scene(light=LIGHT))
    assert np.array_equal(scene.frame.centre, plain.frame.centre) and scene.frame.scale == plain.frame.scale
    check_appearance_inputs(scene)
    with pytest.raises(UserError, match="no base shape"):
        load_edit_scene(make_scene(light=AREA, base=""))
