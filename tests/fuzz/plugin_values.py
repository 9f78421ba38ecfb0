"""Plugins that are written as their manual says, but for the numbers."""

from __future__ import annotations

import re
from pathlib import Path
from random import Random

NUMBERS = (
    "0 -0 1 -1 0.5 2 1e-9 1e-40 1e-300 1e9 1e20 1e38 -1e38 1e39 1e300 nan inf -inf 0.999999999 1.000001 90 180 360 1000"
).split()
INTEGERS = "0 1 -1 2 3 7 64 4096 65536 1000000 2147483647 -2147483648 4294967296 1000000000000".split()

_MATRIX = '<transform name="to_world"><matrix value="# # # # # # # # # # # # 0 0 0 1"/></transform>'
_MOVED = (
    '<transform name="to_world"><scale value="#"/><rotate x="#" y="1" angle="#"/><translate x="#" y="2"/></transform>'
)
_POINT = '<point name="{}" x="#" y="#" z="#"/>'


def _floats(*names: str) -> str:
    return "".join(f'<float name="{name}" value="#"/>' for name in names)


EMITTERS = (
    '<emitter type="point">' + _POINT.format("position") + '<rgb name="intensity" value="#, #, #"/></emitter>',
    f'<emitter type="spot">{_floats("intensity", "cutoff_angle", "beam_width")}{_MOVED}</emitter>',
    f'<emitter type="directional"><vector name="direction" x="#" y="#" z="#"/>{_floats("irradiance")}</emitter>',
    f'<emitter type="sunsky">{_floats("turbidity", "sun_scale", "sky_scale", "sun_aperture")}</emitter>',
    '<emitter type="constant"><float name="radiance" value="#"/></emitter>',
    f'<emitter type="envmap"><string name="filename" value="sky.exr"/>{_floats("scale")}{_MATRIX}</emitter>',
    '<emitter type="projector"><texture type="bitmap" name="irradiance"><string name="filename" value="paint.png"/>'
    f"</texture>{_floats('fov', 'scale')}{_MOVED}</emitter>",
)
BSDFS = (
    f'<bsdf type="principled">{_floats("roughness", "metallic", "anisotropic", "spec_trans", "specular", "spec_tint")}'
    f"{_floats('sheen', 'sheen_tint', 'flatness', 'clearcoat', 'clearcoat_gloss')}</bsdf>",
    f'<bsdf type="principled">{_floats("eta", "roughness")}</bsdf>',
    f'<bsdf type="principledthin">{_floats("roughness", "eta", "diff_trans", "flatness")}</bsdf>',
    f'<bsdf type="dielectric">{_floats("int_ior", "ext_ior")}</bsdf>',
    f'<bsdf type="thindielectric">{_floats("int_ior", "ext_ior")}</bsdf>',
    f'<bsdf type="roughdielectric">{_floats("int_ior", "ext_ior", "alpha")}</bsdf>',
    f'<bsdf type="plastic">{_floats("int_ior", "ext_ior")}<rgb name="diffuse_reflectance" value="#, #, #"/></bsdf>',
    f'<bsdf type="roughplastic">{_floats("int_ior", "alpha")}</bsdf>',
    '<bsdf type="conductor"><rgb name="eta" value="#, #, #"/><rgb name="k" value="#, #, #"/></bsdf>',
    f'<bsdf type="roughconductor"><string name="material" value="Au"/>{_floats("alpha_u", "alpha_v")}</bsdf>',
    f'<bsdf type="mask">{_floats("opacity")}<bsdf type="diffuse"/></bsdf>',
    f'<bsdf type="blendbsdf">{_floats("weight")}<bsdf type="diffuse"/><bsdf type="conductor"/></bsdf>',
    '<bsdf type="bumpmap"><texture type="bitmap" name="arbitrary"><boolean name="raw" value="true"/>'
    '<string name="filename" value="paint.png"/></texture><float name="scale" value="#"/><bsdf type="diffuse"/></bsdf>',
    '<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"><transform name="to_uv">'
    '<scale x="#" y="#"/></transform><rgb name="color0" value="#, #, #"/></texture></bsdf>',
    '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="paint.png"/>'
    '<transform name="to_uv"><scale x="#" y="#"/><translate x="#"/></transform></texture></bsdf>',
    '<bsdf type="diffuse"><spectrum name="reflectance" value="#:#, #:#, #:#"/></bsdf>',
    '<bsdf type="diffuse"><texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/>'
    f"{_floats('scale')}</texture></bsdf>",
)
SHAPES = (
    f'<shape type="sphere">{_floats("radius")}{_POINT.format("center")}</shape>',
    f'<shape type="sphere">{_MATRIX}</shape>',
    f'<shape type="cylinder">{_floats("radius")}{_POINT.format("p0")}{_POINT.format("p1")}</shape>',
    *(f'<shape type="{kind}">{_MATRIX}</shape>' for kind in ("disk", "rectangle", "cube")),
    f'<shape type="ply"><string name="filename" value="body.ply"/>{_MATRIX}</shape>',
    f'<shape type="obj"><string name="filename" value="head.obj"/>{_MOVED}</shape>',
    '<shape type="serialized"><string name="filename" value="head.serialized"/>'
    '<integer name="shape_index" value="%"/></shape>',
    '<shape type="shapegroup" id="herd"><shape type="sphere"/></shape><shape type="instance"><ref id="herd"/>'
    f"{_MATRIX}</shape>",
    f'<shape type="sphere">{_MOVED}<emitter type="area"><rgb name="radiance" value="#, #, #"/></emitter></shape>',
    f'<shape type="focal_region" id="more">{_MOVED}</shape>',
    f'<shape type="focal_region" id="more"><string name="filename" value="head.obj"/>{_MATRIX}</shape>',
)
OTHERS = (
    f'<sensor type="perspective">{_floats("fov", "near_clip", "far_clip")}{_MOVED}<film type="hdrfilm">'
    '<integer name="width" value="%"/><integer name="height" value="%"/><rfilter type="gaussian">'
    '<float name="stddev" value="#"/></rfilter></film>'
    '<sampler type="independent"><integer name="sample_count" value="%"/></sampler></sensor>',
    f'<sensor type="thinlens">{_floats("aperture_radius", "focus_distance", "fov")}</sensor>',
    f'<medium type="homogeneous" id="fog"><rgb name="albedo" value="#, #, #"/>{_floats("sigma_t", "scale")}'
    f'<phase type="hg">{_floats("g")}</phase></medium>',
    '<integrator type="path"><integer name="max_depth" value="%"/><integer name="rr_depth" value="%"/></integrator>',
)


def _filled(template: str, rng: Random, share: float) -> str:
    """The text with a number for every # and %; most are sound, so that an odd one is not hidden by another."""

    def number(match: re.Match[str]) -> str:
        odd, sound = (NUMBERS, ["0.3", "0.7", "1"]) if match.group() == "#" else (INTEGERS, ["8"])
        return rng.choice(odd if rng.random() < share else sound)

    return re.sub("[#%]", number, template)


def plugin_values(rng: Random, folder: Path) -> list[str]:
    """One to three such plugins in the scene; a BSDF is on the base, on a ball beside it, or the part's."""
    path = folder / "scene.xml"
    text = path.read_text()
    for _ in range(rng.randint(1, 3)):
        group = rng.choice([EMITTERS, BSDFS, SHAPES, OTHERS])
        odd = rng.choice(group)
        odd = _filled(odd, rng, rng.choice([0.1, 0.3, 1.0]))
        if group is BSDFS and rng.random() < 0.5:
            text = text.replace('<ref id="paint"/>', odd, 1)
        elif group is BSDFS:
            odd = f'<shape type="sphere"><transform name="to_world"><scale value="0.1"/></transform>{odd}</shape>'
            text = text.replace("</scene>", f"{odd}</scene>")
        else:
            text = text.replace("</scene>", f"{odd}</scene>")
    path.write_text(text)
    return ["check", str(path), "-c", str(folder / "settings.toml")]
