"""JPEGs of a high dynamic range: decoded by the formula of the specification, they are what went in."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.io.gain_map import gain_map_jpeg
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.studio.scene_light import scene_light


def decoded(data: bytes) -> np.ndarray:
    """(H, W, 3) by what the file says of itself: the list of its images, and the numbers of its gain map."""
    at = data.index(b"MPF\0") + 4
    sizes = [struct.unpack_from(">III", data, at + 50 + 16 * number) for number in range(2)]
    assert sizes[0][1] + sizes[1][1] == len(data) and sizes[0][1] == at + sizes[1][2]
    second = data[at + sizes[1][2] :]
    (stops, offset) = (float(re.search(rf'{key}="([^"]+)"'.encode(), second)[1]) for key in ("GainMapMax", "OffsetHDR"))
    shown, gain = (np.asarray(Image.open(io.BytesIO(piece)), dtype=np.float64) / 255 for piece in (data, second))
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    return (linear + offset) * 2 ** (stops * gain) - offset


def test_values_come_back() -> None:
    smooth = np.linspace(0, 1, 64)[None, :, None] * np.linspace(0, 1, 32)[:, None, None] * np.array([1.0, 0.7, 0.4])
    values = 20 * smooth**3
    found = decoded(gain_map_jpeg(values))
    assert np.abs(found - values).max() < 0.05 * values.max() and np.abs(found - values).mean() < 0.02
    dark = decoded(gain_map_jpeg(0.5 * smooth))
    assert np.abs(dark - 0.5 * smooth).max() < 0.02  # nothing brighter than white


SUN = """<emitter type="envmap" id="light"><string name="filename" value="sun.exr"/>
  <transform name="to_world"><rotate y="1" angle="{angle}"/></transform></emitter>"""


def test_light_comes_from_where_mitsuba_has_it(make_scene: Callable[..., Path], mi: Any, tmp_path: Path) -> None:
    """Against Mitsuba's own picture of it: a sensor in the middle that looks along +x, then along +z."""
    sky = np.full((16, 32, 3), 0.1, np.float32)
    sky[5, 3] = (40, 30, 20)
    with file_threads():
        mi.Bitmap(sky).write(str(tmp_path / "sun.exr"))
    path = make_scene(light=SUN.format(angle=50))
    light = scene_light(load_edit_scene(path))
    assert light is not None
    image = decoded(light)
    rows = np.sin((np.arange(len(image)) + 0.5) * np.pi / len(image))
    assert image.mean(axis=(1, 2)) @ rows / rows.sum() == pytest.approx(0.9, rel=0.05)
    height, width = image.shape[:2]
    row, column = np.unravel_index(image.sum(axis=2).argmax(), image.shape[:2])
    around, down = 2 * np.pi * ((column + 0.5) / width - 0.5), np.pi * (row + 0.5) / height
    to_sun = np.array([np.sin(down) * np.cos(around), np.cos(down), np.sin(down) * np.sin(around)])
    camera = {
        "type": "perspective",
        "fov": 20,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], to_sun.tolist(), [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
    }
    emitter = {"type": "envmap", "filename": str(tmp_path / "sun.exr")}
    emitter["to_world"] = mi.ScalarTransform4f().rotate([0, 1, 0], 50)
    whole = {"type": "scene", "light": emitter, "camera": camera, "integrator": {"type": "path"}}
    with file_threads():
        scene = mi.load_dict(whole, parallel=False)
    seen = np.array(mi.render(scene, spp=16))[:, :, 0]
    brightest = np.array(np.unravel_index(seen.argmax(), seen.shape))
    assert np.abs(brightest - 15.5).max() <= 6  # of 32 pixels in 20 degrees; a texel has 11


def test_lamps_in_the_scene_are_no_light_from_all_around(make_scene: Callable[..., Path], mi: Any) -> None:
    lamp = '<emitter type="point" id="light"><point name="position" x="0" y="4" z="0"/></emitter>'
    assert scene_light(load_edit_scene(make_scene(light=lamp))) is None
    assert scene_light(load_edit_scene(make_scene())) is None  # a constant one, which shows no shapes
