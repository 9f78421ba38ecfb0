"""A part with the same material everywhere: the stage's own picture against stock Mitsuba's of the exported scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import BASE

from fd_mitsuba.config import RunConfig
from fd_mitsuba.export.assets import PartAsset, export_assets
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.part_shading import PartShading
from fd_mitsuba.render.tonemap import to_linear
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.part_material import part_material
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.views import CameraBatch

SIZE, SPP = 24, 2048
COLOUR = to_linear(torch.tensor([204, 153, 51]) / 255)  # values that a picture of 8 bits holds exactly
ALPHA, METALLIC = 102 / 255, 51 / 255
LAMP = """<shape type="rectangle" id="lamp"><transform name="to_world"><scale value="0.6"/>
    <lookat origin="1.5, 2.2, 1.2" target="0, 0.2, 0" up="0, 1, 0"/></transform>
    <emitter type="area"><rgb name="radiance" value="9, 8, 7"/></emitter></shape>
    <emitter type="constant"><rgb name="radiance" value="0.2, 0.25, 0.3"/></emitter>"""
PARTS = {
    "principled": '<bsdf type="principled" id="part"><float name="specular" value="0.4"/></bsdf>',
    "roughplastic": '<bsdf type="roughplastic" id="part"><float name="alpha" value="0.3"/></bsdf>',
    "roughconductor": '<bsdf type="roughconductor" id="part"><string name="material" value="none"/></bsdf>',
}


@pytest.mark.parametrize("plugin", PARTS)
def test_stock_mitsuba_sees_the_same_light(
    make_scene: Callable[..., Path], tmp_path: Path, mi: Any, plugin: str
) -> None:
    scene = load_edit_scene(make_scene(light=LAMP, part=PARTS[plugin], base=BASE))
    material = part_material(scene)
    fields = {"base_color": COLOUR, "roughness": torch.tensor([0.5]), "metallic": torch.tensor([METALLIC])}
    if "roughness" in material.squared:
        fields["roughness"] = torch.tensor([ALPHA**0.5])

    def values(points: torch.Tensor) -> SimpleNamespace:
        same = {name: value.float().expand(len(points), -1) for name, value in fields.items()}
        return SimpleNamespace(**same, normal=torch.tensor([[0.0, 0.0, 1.0]]).expand(len(points), 3))

    vertices, faces = unit_sphere(3)
    top = scene.base_canonical.vertices[:, 1].max()
    vertices = 0.25 * np.asarray(vertices) + [0, top + 0.2, 0]
    view = CameraBatch.around(np.array([35.0]), 30.0, 3.0, 35.0, np.array([[0.0, 0.6 * top, 0.0]]))

    shape = SimpleNamespace(vertices=vertices, faces=np.asarray(faces))
    own = AppearancePass(scene, {"part": shape}, PartShading.of(material), SIZE, SPP)
    gbuffer = own.trace(view, 3)
    said = values(gbuffer.points)
    pictures = own.render(gbuffer, said.base_color, said.roughness, said.metallic, None, seed=3)

    part = PartAsset(scene.frame.to_user(vertices), shape.faces, values)
    export_assets(scene, RunConfig(), {"part": part}, tmp_path / "out", texture_size=64, formats=["mitsuba"])
    exported = mi.load_file(str(tmp_path / "out" / "mitsuba" / "scene.xml"), parallel=False)
    position, target = scene.frame.to_user(view.position[0]), scene.frame.to_user(view.target[0])
    eye = mi.ScalarTransform4f().look_at(position.tolist(), target.tolist(), [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "component_format": "float32"}
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(view.fov_deg[0]),
            "to_world": eye,
            "film": film,
            "sampler": {"type": "independent"},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 2, "hide_emitters": True})
    stock = np.array(mi.render(exported, sensor=sensor, integrator=integrator, spp=2 * SPP, seed=5))[..., :3]
    merged = pictures.merged[0].permute(1, 2, 0).numpy()
    whole, none = (gbuffer.part_mask[0, 0].numpy() == share for share in (1, 0))
    assert whole.sum() > 20 and gbuffer.alpha[0, 0].numpy()[none].sum() > 50
    for where in (whole, none):
        assert merged[where].sum(axis=0) == pytest.approx(stock[where].sum(axis=0), rel=5e-3)
