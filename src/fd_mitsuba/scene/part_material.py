"""The part's BSDF in the scene file: what of it the texture field feeds, what stays as it is, and where it starts.

A constant of a learnable parameter (`<float>`, `<rgb>`, `<spectrum>`, or Mitsuba's own default) is where learning
starts. A parameter given as a `<texture>`, such as a `uniform` one, is fixed, and so is every other parameter.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.conventions import DEFAULT_PART_NAME, TEXTURE_CHANNELS
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.bsdf_reading import COLOURS, PlainMaterial, child_objects, read_material
from fd_mitsuba.scene.edit_scene import EditScene

_PARAMETERS = {"base_color": COLOURS, "roughness": ("roughness", "alpha"), "metallic": ("metallic",)}
"""The parameters that a channel may feed, the first that the BSDF takes a texture for."""


@dataclass(frozen=True)
class PartMaterial:
    """What becomes of the part's BSDF; made by `part_material`.

    Attributes:
        plugin: the BSDF's type, that of the inner one where it is wrapped.
        description: the BSDF as the scene file has it, for `mi.load_dict`.
        learned: the channels that the field learns, in the order of `TEXTURE_CHANNELS`.
        feeds: learned channel -> parameter that takes its texture, such as {"base_color": "reflectance"}; dots lead
            through nested dictionaries of `description`. "normal" has none: it bends the shading normal.
        squared: the learned channels whose square is fed: a microfacet alpha is the square of the roughness.
        start: the material before the first step, and for good in the channels that are not learned.
        message: one line for the user that says what is learned and what is not.
    """

    plugin: str
    description: dict[str, Any]
    learned: tuple[str, ...]
    feeds: dict[str, str]
    squared: frozenset[str]
    start: PlainMaterial
    message: str


def part_material(scene: EditScene, fixed: Collection[str] = (), normal_map: bool = True) -> PartMaterial:
    """What of the scene's `<bsdf id="part">`, or of a plain `principled` if it has none, can be learned.

    Args:
        scene: what to edit.
        fixed: channels of `TEXTURE_CHANNELS` that are not to be learned.
        normal_map: whether the field may bend the shading normal.

    Raises:
        UserError: nothing is left to learn; several BSDFs in one; a texture that varies over the surface, since the
            part has no UVs and no vertex attributes while it is learned.
    """
    file, element = scene.inputs.part_bsdf()
    owner = f'{file.path}: <bsdf id="{DEFAULT_PART_NAME}">' if element is None else f"{element.where}: {element}"
    description = {"type": "principled"} if element is None else file.description(element)
    prefix = _prefix_of_innermost(file.mi, description, owner)
    inner = _follow(description, prefix)
    whole = _load(file.mi, description)
    for path, texture in _textures(file.mi, whole):
        if texture.is_spatially_varying():
            raise UserError(
                f"{owner}: texture {path} varies over the surface, but the part has no UVs; give a constant"
            )
    feeds: dict[str, str] = {}
    kept, refused = [], []
    for channel, names in _PARAMETERS.items():
        if channel in fixed or any(isinstance(inner.get(name), dict) for name in names):
            kept.append(channel)
        elif parameter := _first_that_takes_a_texture(file.mi, description, prefix, names):
            feeds[channel] = prefix + parameter
        else:
            refused.append(channel)
    if not feeds:
        why = (
            f"fixed: {', '.join(kept)}" if kept else f"a {inner['type']} has no base colour or roughness that can vary"
        )
        raise UserError(f"{owner}: the part's material has nothing to learn ({why}); use a principled, for one")
    bends = normal_map and "normal" not in fixed
    kept += [] if bends else ["normal"]
    learned = tuple(name for name in TEXTURE_CHANNELS if name in feeds or (name == "normal" and bends))
    fed = {name: path.removeprefix(prefix) for name, path in feeds.items()}
    spoken = [f"{name} ({fed[name]})" if fed.get(name, name) != name else name for name in learned]
    message = f"part material: {inner['type']} learns {', '.join(spoken)}"
    message += f"; fixed: {', '.join(kept)}" if kept else ""
    message += f"; cannot vary over its surface: {', '.join(refused)}" if refused else ""
    squared = frozenset(name for name, parameter in fed.items() if parameter == "alpha")
    start = _start(file.mi, whole, factor=fed.get("base_color") == "specular_reflectance")
    return PartMaterial(inner["type"], description, learned, feeds, squared, start, message)


def _load(mi: Any, description: dict[str, Any]) -> Any:
    with file_threads():
        return mi.load_dict(description, parallel=False)


def _follow(description: dict[str, Any], prefix: str) -> dict[str, Any]:
    for key in prefix.split(".")[:-1]:
        description = description[key]
    return description


def _with(description: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy with another value at a dotted path."""
    key, _, rest = path.partition(".")
    return {**description, key: _with(description[key], rest, value) if rest else value}


def _prefix_of_innermost(mi: Any, description: dict[str, Any], owner: str) -> str:
    """Dotted path, with a dot at its end, of the BSDF within wrappers such as `mask`; a `twosided`'s is the front's."""
    nested = [key for key, value in description.items() if isinstance(value, dict) and _is_bsdf(mi, value)]
    if not nested:
        return ""
    if len(nested) > 1 and description["type"] != "twosided":
        raise UserError(f"{owner}: a {description['type']} of {len(nested)} BSDFs cannot be learned; use one of them")
    return f"{nested[0]}." + _prefix_of_innermost(mi, description[nested[0]], owner)


def _is_bsdf(mi: Any, description: dict[str, Any]) -> bool:
    return isinstance(_load(mi, description), mi.BSDF)


def _first_that_takes_a_texture(
    mi: Any, description: dict[str, Any], prefix: str, names: tuple[str, ...]
) -> str | None:
    """The first of the innermost BSDF's parameters `names` that may be a texture; found by trying."""
    import drjit as dr

    texture = mi.load_dict({"type": "bitmap", "data": dr.full(mi.TensorXf, 0.5, (2, 2, 3)), "raw": True})
    for name in names:
        try:
            bsdf = _load(mi, _with(description, prefix + name, texture))
        except RuntimeError:
            continue  # it wants a number there, or does not know the name
        # What a transmitting BSDF calls specular reflectance is no colour of its surface.
        if name == "specular_reflectance" and mi.has_flag(_leaf(mi, bsdf).flags(), mi.BSDFFlags.Transmission):
            continue
        if any(path.rpartition(".")[2] == name and found == texture for path, found in _textures(mi, bsdf)):
            return name
    return None


def _leaf(mi: Any, bsdf: Any) -> Any:
    nested = [child for child in child_objects(mi, bsdf).values() if isinstance(child, mi.BSDF)]
    return _leaf(mi, nested[0]) if nested else bsdf


def _textures(mi: Any, bsdf: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Path and texture of everything textured below a BSDF."""
    for name, child in child_objects(mi, bsdf).items():
        if isinstance(child, mi.Texture):
            yield prefix + name, child
        elif isinstance(child, mi.BSDF):
            yield from _textures(mi, child, f"{prefix}{name}.")


def _start(mi: Any, whole: Any, factor: bool) -> PlainMaterial:
    """The BSDF's own constants; `factor`: base colour means the factor on a metal's colour, which the BSDF keeps."""
    import drjit as dr

    interaction = dr.zeros(mi.SurfaceInteraction3f, 1)
    reading = read_material(mi, whole, interaction, 1)
    color, plain = reading.base_color[0], PlainMaterial()
    if factor:
        given = child_objects(mi, _leaf(mi, whole)).get("specular_reflectance")
        color = np.ones(3) if given is None else np.array(given.eval(interaction), dtype=np.float64).reshape(-1)
    color = np.broadcast_to(np.where(np.isnan(color), plain.base_color, color), (3,))
    roughness, metallic = reading.roughness[0], reading.metallic[0]
    return PlainMaterial(
        (float(color[0]), float(color[1]), float(color[2])),
        plain.roughness if np.isnan(roughness) else float(roughness),
        plain.metallic if np.isnan(metallic) else float(metallic),
    )
