"""Close-ups of exported parts, as clay and as gold: `python benchmarks/part_closeups.py RUN... -o FOLDER [--size 768]`.

A sheet of four views for each part of each run folder: the whole part from two sides, then the joint from two sides,
framed as from half a metre if the object is one metre high.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "src")]

import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

from fd_mitsuba.backend import startup  # noqa: E402
from fd_mitsuba.evaluation.joint import joint_curves  # noqa: E402
from fd_mitsuba.export.final_surface.final_part import FinalPart, final_part  # noqa: E402
from fd_mitsuba.io.srgb import srgb_from_linear  # noqa: E402
from fd_mitsuba.runs.geometry_outcome import load_finished_stage  # noqa: E402
from fd_mitsuba.runs.saved_run import saved_run  # noqa: E402
from fd_mitsuba.scene.mesh_distance import MeshDistance  # noqa: E402
from fd_mitsuba.scene.triangle_mesh import TriangleMesh  # noqa: E402
from fd_mitsuba.viewing.denoising import denoised, has_denoiser  # noqa: E402

_FOV_DEG, _SPP = 30.0, 16
_CLAY = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.55, 0.3]}}}
_GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.15}
_STONE = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.35, 0.42, 0.5]}}}

View = tuple[np.ndarray, float, float, float]
"""Target (3,), azimuth and elevation in degrees, distance."""


def shapes(mi: Any, base: TriangleMesh, part: FinalPart, material: dict[str, Any]) -> dict[str, Any]:
    """Base and part as meshes of Mitsuba; only the part has smooth normals."""
    made = {}
    for name, vertices, faces, normals, bsdf in (
        ("base", base.vertices, base.faces, None, _STONE),
        ("part", part.solid.vertices, part.solid.faces, part.normals, material),
    ):
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(bsdf)
        mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=normals is not None, props=properties)
        values = mi.traverse(mesh)
        values[startup.VERTICES] = np.ascontiguousarray(vertices, np.float32).ravel()
        values[startup.FACES] = np.ascontiguousarray(faces, np.uint32).ravel()
        if normals is not None:
            values[startup.NORMALS] = np.ascontiguousarray(normals, np.float32).ravel()
        values.update()
        made[name] = mesh
    return made


def picture(mi: Any, scene: Any, view: View, size: int) -> np.ndarray:
    """(size, size, 3) uint8."""
    target, azimuth, elevation, distance = view
    a, e = np.radians(azimuth), np.radians(elevation)
    origin = target + distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    place = mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target.tolist(), up=[0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    film["component_format"] = "float32"
    sensor = mi.load_dict(
        {"type": "perspective", "fov": _FOV_DEG, "near_clip": 0.01, "to_world": place, "film": film}
    )  # fmt: skip
    path, guides = ({"type": "path", "max_depth": 4}, {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    image = np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict(path), spp=_SPP))[..., :3]
    if has_denoiser():
        seen = np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict(guides), spp=4))
        image = denoised(image, np.clip(seen[..., :3], 0, 1), seen[..., 3:6])
    return np.round(255 * srgb_from_linear(np.clip(image, 0, 1))).astype(np.uint8)


def views_of(base: TriangleMesh, part: FinalPart) -> list[View]:
    """Two of the whole part, two of its joint."""
    vertices = part.solid.vertices
    middle, reach = (vertices.min(axis=0) + vertices.max(axis=0)) / 2, float(np.ptp(vertices, axis=0).max())
    curves = joint_curves(vertices, part.solid.faces, MeshDistance(base.vertices, base.faces))
    places = np.concatenate(curves) if curves else vertices
    found: list[View] = [(middle, 30.0, 20.0, 2.2 * reach), (middle, 210.0, 30.0, 2.2 * reach)]
    for azimuth in (35.0, 215.0):
        facing = places @ np.array([np.sin(np.radians(azimuth)), 0.0, np.cos(np.radians(azimuth))])
        found.append((places[int(facing.argmax())], azimuth, 25.0, 0.7))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--size", type=int, default=768)
    options = parser.parse_args()
    mi = startup.start()
    options.output.mkdir(parents=True, exist_ok=True)
    for folder in options.runs:
        scene, config = saved_run(folder)
        grown = load_finished_stage(scene, config, folder).grown()
        for name in scene.parts:
            part = final_part(grown, name, config.output.faces)
            views = views_of(scene.base_canonical, part)
            for word, material in (("clay", _CLAY), ("gold", _GOLD)):
                lights = {
                    "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.45}},
                    "sun": {"type": "directional", "direction": [-0.5, -1, -0.45],
                            "irradiance": {"type": "rgb", "value": 1.6}},
                }  # fmt: skip
                world = mi.load_dict({"type": "scene", **lights, **shapes(mi, scene.base_canonical, part, material)})
                seen = [picture(mi, world, view, options.size) for view in views]
                sheet = np.concatenate([np.concatenate(seen[:2], axis=1), np.concatenate(seen[2:], axis=1)])
                Image.fromarray(sheet).save(options.output / f"{folder.name}_{name}_{word}.png")


if __name__ == "__main__":
    main()
