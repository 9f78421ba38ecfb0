"""What a BSDF says about base colour, roughness and metallic, read through Mitsuba itself.

Textures, UV transforms, sRGB decoding and mesh attributes are evaluated by the BSDF's own textures. The words are
those of `principled`, so that other BSDFs are translated:

| BSDF | base colour | roughness | metallic |
|---|---|---|---|
| `principled` and custom ones with its names | `base_color` | `roughness` | `metallic` |
| `diffuse` | `reflectance` | 1 | 0 |
| `plastic`, `roughplastic`, `pplastic` | `diffuse_reflectance` | 0, or the root of `alpha` | 0 |
| `conductor`, `roughconductor` | Fresnel reflectance at 0 degrees times `specular_reflectance` | likewise | 1 |
| `roughdielectric` | - | the root of `alpha` | - |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

COLOURS = ("base_color", "reflectance", "diffuse_reflectance", "specular_reflectance")
"""Parameters that may hold a BSDF's base colour, the first one that it has counts."""


@dataclass(frozen=True)
class PlainMaterial:
    """One material for a whole surface; base colour is linear."""

    base_color: tuple[float, float, float] = (0.5, 0.5, 0.5)
    roughness: float = 0.5
    metallic: float = 0.0


@dataclass(frozen=True)
class Reading:
    """A material at N points, NaN throughout in what the BSDF does not say."""

    base_color: np.ndarray
    """(N, 3) float64, linear."""
    roughness: np.ndarray
    """(N,) as `principled` means it."""
    metallic: np.ndarray
    """(N,)."""

    @property
    def says_anything(self) -> bool:
        """Whether any of the three is given."""
        return not all(np.isnan(values).all() for values in (self.base_color, self.roughness, self.metallic))


def child_objects(mi: Any, node: Any) -> dict[str, Any]:
    """The BSDFs and textures right below a Mitsuba object, by parameter name."""
    found: dict[str, Any] = {}

    class Collector(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int, kind: Any = None) -> None:
            self.put_object(name, value, flags)

        def put_value(self, name: str, value: Any, flags: int, kind: Any = None) -> None:
            pass

        def put_object(self, name: str, value: Any, flags: int) -> None:
            if isinstance(value, mi.Object):
                found[name] = value

    node.traverse(Collector())
    return found


def read_material(mi: Any, bsdf: Any, interaction: Any, count: int) -> Reading:
    """The material of a BSDF at `count` surface interactions. Nothing is differentiated.

    Wrappers (`mask`, `bumpmap`, `normalmap`, `twosided`: its front) are looked through, `blendbsdf` is mixed.
    """
    children = child_objects(mi, bsdf)
    nested = [child for child in children.values() if isinstance(child, mi.BSDF)]
    weight: Any = children.get("weight")
    if len(nested) == 2 and isinstance(weight, mi.Texture):
        share = np.clip(_scalar(weight.eval_1(interaction), count), 0, 1)
        first, second = (read_material(mi, child, interaction, count) for child in nested)
        return Reading(
            first.base_color + share[:, None] * (second.base_color - first.base_color),
            first.roughness + share * (second.roughness - first.roughness),
            first.metallic + share * (second.metallic - first.metallic),
        )
    if nested:
        return read_material(mi, nested[0], interaction, count)
    return _read_leaf(mi, bsdf, children, interaction, count)


def _read_leaf(mi: Any, bsdf: Any, children: dict[str, Any], interaction: Any, count: int) -> Reading:
    def has(name: str) -> bool:
        return isinstance(children.get(name), mi.Texture) or bool(np.all(np.array(bsdf.has_attribute(name))))

    def scalar(name: str) -> np.ndarray:
        texture: Any = children.get(name)
        is_texture = isinstance(texture, mi.Texture)
        value = texture.eval_1(interaction) if is_texture else bsdf.eval_attribute_1(name, interaction)
        return _scalar(value, count)

    def colour(name: str) -> np.ndarray:
        texture: Any = children.get(name)
        is_texture = isinstance(texture, mi.Texture)
        value = texture.eval(interaction) if is_texture else bsdf.eval_attribute_3(name, interaction)
        return _colour(value, count)

    unknown, ones = np.full(count, np.nan), np.ones(count)
    is_conductor = has("eta") and has("k")
    transmits = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission) and not has("base_color")
    base_color = np.repeat(unknown[:, None], 3, axis=1)
    named = [name for name in COLOURS if has(name)]
    if is_conductor:
        eta, k = colour("eta"), colour("k")
        base_color = ((eta - 1) ** 2 + k * k) / ((eta + 1) ** 2 + k * k)
        base_color = base_color * (colour("specular_reflectance") if has("specular_reflectance") else 1.0)
    elif named and not transmits:
        base_color = colour(named[0])
    if has("roughness"):
        roughness = scalar("roughness")
    elif has("alpha"):
        roughness = np.sqrt(scalar("alpha").clip(min=0))
    elif has("alpha_u") and has("alpha_v"):
        roughness = np.sqrt(np.sqrt((scalar("alpha_u") * scalar("alpha_v")).clip(min=0)))
    elif "reflectance" in named:
        roughness = ones
    else:
        roughness = 0 * ones if is_conductor or "diffuse_reflectance" in named else unknown
    if has("metallic"):
        metallic = scalar("metallic")
    else:
        metallic = unknown if np.isnan(base_color).any() else ones if is_conductor else 0 * ones
    return Reading(base_color, roughness, metallic)


def _scalar(value: Any, count: int) -> np.ndarray:
    return np.broadcast_to(np.array(value, dtype=np.float64).reshape(-1), (count,)).copy()


def _colour(value: Any, count: int) -> np.ndarray:
    import drjit as dr

    # As a whole it would be interleaved by a kernel that is compiled anew for every size.
    dr.eval(value)
    channels = [_scalar(channel, count) for channel in value]
    return np.stack(channels if len(channels) == 3 else 3 * channels[:1], axis=1)
