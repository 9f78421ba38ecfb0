"""How far the part's colour jumps where it meets the base: what style consistency is there to lower."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.fields.textures_apart import TexturesApart
from fd_mitsuba.render.appearance_scene import Triangles
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.scene.base_appearance import BaseAppearance
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.surface_points import points_on

_POINTS = 16384


@torch.no_grad()
def boundary_step(
    scene: EditScene, parts: Iterable[Triangles], field: TextureField | TexturesApart, reach: float, seed: int = 0
) -> float | None:
    """Mean over the part's points near the base of `|kd_part(x) - kd_base(nearest)|`, the root mean square of channels.

    In sRGB, so in [0, 1]. None where no point is near, or the base's BSDFs there have no base colour.

    Args:
        parts: meshes, canonical frame.
        reach: what counts as near, canonical units; `appearance.boundary_reach` in a run.
    """
    points = points_on(parts, _POINTS, seed)
    base = BaseAppearance(scene)
    points = points[base.distance(points) < reach]
    if not len(points):
        return None
    beside = base.lookup(points)
    known = beside.known[:, :3].all(dim=1)
    if not known.any():
        return None
    difference = (to_srgb(field(points).base_color) - to_srgb(beside.base_color))[known]
    return float(difference.square().mean(dim=1).sqrt().mean())
