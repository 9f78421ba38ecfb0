"""A small scene for the appearance pass, and the same scene as stock Mitsuba would render it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from conftest import INTEGRATOR, REGION, write_ply

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.scene.scene_file import ready_mitsuba

mi = ready_mitsuba()

from fd_mitsuba.render.appearance_pass import AppearancePass, AppearancePictures  # noqa: E402
from fd_mitsuba.render.gbuffer import GBuffer  # noqa: E402
from fd_mitsuba.render.part_shading import CHANNELS, PartShading  # noqa: E402
from fd_mitsuba.scene.edit_scene import EditScene  # noqa: E402
from fd_mitsuba.scene.load_scene import load_edit_scene  # noqa: E402
from fd_mitsuba.scene.triangle_mesh import TriangleMesh  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

WHITE = '<emitter type="constant" id="light"/>'
AREA = """<shape type="rectangle" id="lamp">
    <transform name="to_world">
      <scale value="0.5"/><rotate x="1" angle="90"/><translate x="2.2" y="4" z="1.8"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="60, 54, 48"/></emitter>
  </shape>"""
"""A square lamp above the scene that shines down."""

FEEDS = {
    "principled": {"base_color": "base_color", "roughness": "roughness", "metallic": "metallic"},
    "roughplastic": {"base_color": "diffuse_reflectance"},
    "roughconductor": {"base_color": "specular_reflectance", "roughness": "alpha"},
    "diffuse": {"base_color": "reflectance"},
}
CONSTANT = {"base_color": (0.7, 0.5, 0.2), "roughness": (0.4,), "metallic": (0.3,)}


def write_sky(folder: Path) -> str:
    """An HDR sky with a small bright sun and a horizon, and the emitter that shows it."""
    height, width = 16, 32
    polar = (np.arange(height) + 0.5) / height * np.pi
    turn = (np.arange(width) + 0.5) / width * 2 * np.pi
    pixels = np.ones((height, width, 3)) * np.where(polar < np.pi / 2, 0.8, 0.2)[:, None, None] * (0.6, 0.8, 1.0)
    sun = (np.cos(turn - 2.0)[None, :] > 0.8) & (np.abs(polar - 0.7) < 0.3)[:, None]
    pixels[sun] += (12.0, 10.0, 8.0)
    path = folder / "sky.exr"
    with file_threads():
        mi.Bitmap(pixels.astype(np.float32)).write(str(path))
    return '<emitter type="envmap" id="light"><string name="filename" value="sky.exr"/></emitter>'


def blocks(folder: Path, light: str, base_bsdf: str = '<bsdf type="diffuse"/>') -> EditScene:
    """A wide flat box, three units across and lifted off the origin, that a part can be put on."""
    box = trimesh.creation.box((3.0, 0.6, 3.0)).subdivide()
    write_ply(folder / "box.ply", box.vertices + (0.5, 1.0, -0.2), box.faces)
    shape = '<shape type="ply" id="box"><string name="filename" value="box.ply"/>'
    shape += f'<boolean name="face_normals" value="true"/>{base_bsdf}</shape>'
    region = REGION.replace('x="0" y="0.35" z="0"', 'x="0.5" y="1.5" z="-0.2"')
    path = folder / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{INTEGRATOR}{light}{shape}{region}</scene>')
    return load_edit_scene(path)


def ball(height: float = 0.55, radius: float = 0.35, subdivisions: int = 3) -> TriangleMesh:
    """A ball over the middle of the base, canonical frame; the base's upper side is at 0.18."""
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return TriangleMesh("part", mesh.vertices + (0.0, height, 0.0), mesh.faces)


def camera(azimuth: float = 30.0, elevation: float = 25.0, fov: float = 26.0, height: float = 0.45) -> CameraBatch:
    """One view of the ball and some of the base."""
    return CameraBatch.around(np.array([azimuth]), elevation, 3.0, fov, np.array([[0.0, height, 0.0]]))


def shading(plugin: str, **fixed: Any) -> PartShading:
    """The stock BSDF, fed by every field that it can have."""
    return PartShading({"type": plugin, **fixed}, FEEDS[plugin])


def constants(gbuffer: GBuffer, plugin: str, values: Mapping[str, tuple[float, ...]]) -> dict[str, torch.Tensor | None]:
    """The same value everywhere for each field of a BSDF, and no bend of the normal."""
    fields: dict[str, torch.Tensor | None] = dict.fromkeys([*CHANNELS, "normal"])
    for name in FEEDS[plugin]:
        fields[name] = torch.tensor([values[name]]).repeat(len(gbuffer.points), 1)
    return fields


def render(
    appearance: AppearancePass, cameras: CameraBatch, plugin: str, seed: int = 3, **values: Any
) -> AppearancePictures:
    """Pictures with constant fields."""
    gbuffer = appearance.trace(cameras, seed)
    return appearance.render(gbuffer, **constants(gbuffer, plugin, {**CONSTANT, **values}), seed=seed)


def stock(
    scene: EditScene,
    part: TriangleMesh | None,
    bsdf: dict[str, Any],
    cameras: CameraBatch,
    size: int,
    spp: int,
    max_depth: int = 2,
    seed: int = 11,
    hide_emitters: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """RGB (S, S, 3), multiplied by coverage, and alpha (S, S) of the first view, by Mitsuba's `path`."""  # fmt: skip
    loaded = scene.mitsuba_scene(without=("focal_region", "sensor", "integrator"))
    content: dict[str, Any] = {f"shape_{i}": shape for i, shape in enumerate(loaded.shapes())}
    lights = [light for light in loaded.emitters() if not mi.has_flag(light.flags(), mi.EmitterFlags.Surface)]
    content |= {f"light_{i}": light for i, light in enumerate(lights)}
    if part is not None:
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(bsdf)
        mesh = mi.Mesh("part", len(part.vertices), len(part.faces), props=properties, has_vertex_normals=True)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ascontiguousarray(scene.frame.to_user(part.vertices).ravel(), np.float32)
        parameters["faces"] = np.ascontiguousarray(part.faces.ravel(), np.uint32)
        parameters.update()
        content["part"] = mesh
    up = cameras.basis()[1][0]
    position, target = scene.frame.to_user(cameras.position[0]), scene.frame.to_user(cameras.target[0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(cameras.fov_deg[0]),
            "to_world": mi.ScalarTransform4f().look_at(position.tolist(), target.tolist(), up.tolist()),
            "film": {
                "type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba",
                "component_format": "float32", "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent"},
        }
    )  # fmt: skip
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "hide_emitters": hide_emitters})
    whole = mi.load_dict({"type": "scene", **content}, optimize=False, parallel=False)
    pixels = np.array(mi.render(whole, sensor=sensor, integrator=integrator, spp=spp, seed=seed))
    return pixels[..., :3], pixels[..., 3]
