"""NaN and infinity anywhere in a scene are refused with the element and its line, before anything is rendered."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import CASES

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.load_scene import load_edit_scene

Make = Callable[..., Path]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scene", ("scene.xml:6", '<emitter type="constant">', "radiance")),
        ("point_position_nan", ("point_position_nan.xml:2", '<emitter type="point">', "position")),
        ("env_rotation_nan", ("env_rotation_nan.xml:2", '<emitter type="envmap">', "to_world")),
    ],
)
def test_lights(name: str, words: tuple[str, ...]) -> None:
    with pytest.raises(UserError) as caught:
        load_edit_scene(CASES / "nan_light" / f"{name}.xml")
    assert all(word in str(caught.value) for word in (*words, "NaN or infinity")), caught.value


BODY = '<shape type="ply" id="body"><string name="filename" value="animal.ply"/>{}</shape>'
SPOT = '<emitter type="spot"><rgb name="intensity" value="{}"/></emitter>'
SUN = '<emitter type="directional"><vector name="direction" x="nan" y="1" z="0"/></emitter>'
LAMP = '<shape type="sphere" id="lamp"><point name="center" x="5" y="5" z="5"/>{}</shape>'


@pytest.mark.parametrize(
    ("pieces", "word"),
    [
        ({"base": BODY.format('<bsdf type="principled"><float name="specular" value="nan"/></bsdf>')}, "specular"),
        ({"base": BODY.format('<bsdf type="principled"><float name="eta" value="inf"/></bsdf>')}, "eta"),
        ({"base": BODY.format('<bsdf type="principled"><float name="clearcoat" value="nan"/></bsdf>')}, "clearcoat"),
        ({"base": BODY.format('<bsdf type="dielectric"><float name="int_ior" value="nan"/></bsdf>')}, "int_ior"),
        ({"base": BODY.format('<bsdf type="roughconductor"><spectrum name="eta" value="nan"/></bsdf>')}, "eta"),
        ({"part": '<bsdf type="principled" id="part"><float name="sheen" value="nan"/></bsdf>'}, "sheen"),
        ({"light": SPOT.format("inf 1 1")}, "intensity"),
        ({"light": SUN}, "direction"),
        ({"light": '<emitter type="point"><spectrum name="intensity" value="400:1, 700:nan"/></emitter>'}, "intensity"),
        (
            {"extra": LAMP.format('<emitter type="area"><rgb name="radiance" value="1 nan 1"/></emitter>')},
            "radiance",
        ),
    ],
)
def test_every_number_that_light_or_shading_reads(make_scene: Make, pieces: dict[str, str], word: str) -> None:
    with pytest.raises(UserError, match=rf"scene\.xml:\d+: <.*>: {word} holds NaN or infinity"):
        load_edit_scene(make_scene(**pieces))


def test_numbers_that_only_a_file_holds(make_scene: Make, tmp_path: Path) -> None:
    """A spectrum from a file is in no property of the scene, but it is in what Mitsuba loads."""
    (tmp_path / "light.spd").write_text("400 1\n500 nan\n700 1\n")
    light = '<emitter type="constant" id="sky"><spectrum name="radiance" filename="light.spd"/></emitter>'
    with pytest.raises(UserError, match="sky.*NaN|NaN.*sky|light.spd"):
        load_edit_scene(make_scene(light=light))


def test_a_sound_scene_is_taken(make_scene: Make) -> None:
    assert np.isfinite(load_edit_scene(make_scene()).base_soup.vertices).all()


def test_parameters_that_cannot_be_read_are_no_error(make_scene: Make) -> None:
    """Those of Mitsuba's `hair`, which has absorption or pigments and offers both."""
    load_edit_scene(make_scene(base=BODY.format('<bsdf type="hair"/>')))
