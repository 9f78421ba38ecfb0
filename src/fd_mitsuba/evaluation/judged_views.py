"""The pictures that judges see: a ring of views of the edited object, of its base, and of what the run started from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.render.appearance_pass import AppearancePass
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.render.tonemap import to_srgb
from fd_mitsuba.runs.preservation import light_may_be_touched
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.appearance_stage import AppearanceStage
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.viewing.lit_views import some_cameras

ELEVATION_DEG, RADIUS, FOV_DEG = 45.0, 3.4, 45.0
BACKGROUND = 0.35
"""Linear grey behind lit and shaded objects, as in a run's own turntable."""
VIEWS_TOGETHER = 10
Kind = Literal["lit", "normals", "shaded"]


@dataclass(frozen=True)
class JudgedViews:
    """N views; pictures are sRGB in [0, 1], float32.

    Attributes:
        kind: lit by the scene; normals as colours (n + 1) / 2 on black, camera space; shaded by a lamp at the camera.
        azimuth_deg: (N,) 0 sees the front.
        edited: (N, 3, S, S) the edited object.
        base: the base alone, from the same cameras and with the same random numbers.
        start: the focal regions in the part's place, as when the run began.
        base_pixels: (N, 1, S, S) bool: pixels that show the base and nothing else, in both of the first two.
        untouched: of these, the ones whose light the part can neither take nor send; all of them without light.
    """

    kind: Kind
    azimuth_deg: np.ndarray
    edited: Tensor
    base: Tensor
    start: Tensor
    base_pixels: Tensor
    untouched: Tensor


def judged_cameras(count: int, aim: np.ndarray) -> CameraBatch:
    """The evaluation's ring: elevation 45 degrees, evenly spread, front first.

    Paper: supplement, "Evaluation Protocol". Distance and field of view are not given there; these are the turntable's.
    """
    turn = np.arange(count) * (360.0 / count)
    return CameraBatch.around(turn, ELEVATION_DEG, RADIUS, FOV_DEG, np.tile(aim, (count, 1)))


@torch.no_grad()
def lit_views(stage: AppearanceStage, count: int, size: int, spp: int) -> JudgedViews:
    """Views of a finished appearance stage under the scene's light; the start has the part BSDF's own values."""
    scene, shading, depth = stage.scene, stage.shading, stage.config.appearance.max_depth
    regions = {region.name: region.surface(3) for region in scene.regions}
    alone = AppearancePass(scene, {}, shading, size, spp, depth)
    begun = AppearancePass(scene, regions, shading, size, spp, depth)
    dual = stage.rendering
    if dual.deferred_base:  # the ablation's pictures, but the masks of the two paths
        dual = AppearancePass(scene, stage.parts, shading, size, spp, depth)
    blank = TextureField(stage.config.texture, 0, stage.material.start, ())
    solids = [scene.render_frame.to_user(np.asarray(mesh.vertices, np.float64)) for mesh in stage.parts.values()]
    cameras = judged_cameras(count, stage.aim)
    rows: dict[str, list[Tensor]] = {name: [] for name in ("edited", "base", "start", "base_pixels", "untouched")}
    for first in range(0, count, VIEWS_TOGETHER):
        few = some_cameras(cameras, slice(first, first + VIEWS_TOGETHER))
        edited, base, start = (which.trace(few, first, size=size, spp=spp) for which in (stage.rendering, alone, begun))
        split = edited if dual is stage.rendering else dual.trace(few, first, size=size, spp=spp)
        whole = (split.base_mask > 0.999) & (base.base_mask > 0.999)
        values = {name: getattr(blank(start.points), name) for name in ("base_color", "roughness", "metallic")}
        linear = {
            "edited": (stage.render(edited, stage.texture(edited), first).merged, edited.alpha),
            "base": (alone.render_base(base, first), base.alpha),
            "start": (begun.render(start, **values, normal=None, seed=first).merged, start.alpha),
        }
        for name, (picture, alpha) in linear.items():
            rows[name].append(to_srgb(picture * stage.exposure + BACKGROUND * (1 - alpha)).clamp(0, 1))
        rows["base_pixels"].append(whole)
        rows["untouched"].append(whole & ~light_may_be_touched(split, solids))
    return JudgedViews("lit", cameras.azimuth_deg, **{name: torch.cat(parts) for name, parts in rows.items()})


@torch.no_grad()
def shape_views(stage: GeometryStage, count: int, size: int, spp: int, kind: Kind) -> JudgedViews:
    """Views of a geometry stage's present shape, without material or light of the scene."""
    cameras = judged_cameras(count, stage.aim)
    shown = _shapes(stage, cameras, size, spp)
    edited, base = shown["edited"], shown["base"]
    whole = (edited[:, 3:4] > 0.999) & (base[:, 3:4] > 0.999) & (edited[:, 4:5] == 0)
    colours = {name: coloured(picture, kind) for name, picture in shown.items()}
    return JudgedViews(kind, cameras.azimuth_deg, **colours, base_pixels=whole, untouched=whole)


def _shapes(stage: GeometryStage, cameras: CameraBatch, size: int, spp: int) -> dict[str, Tensor]:
    rendering = GeometryPass(size, spp, 0, "camera")

    def pictures(surface: UnionSurface) -> Tensor:
        return rendering.render_primal(surface.vertices, surface.faces, surface.part_weight, cameras, seed=0)

    edited, base, start = map(pictures, (stage.surface(), stage.base_surface, stage.start_surface()))
    return {"edited": edited, "base": base, "start": start}


def coloured(pictures: Tensor, kind: Kind) -> Tensor:
    """(N, 3, S, S) in [0, 1] of geometry pictures (N, >= 4, S, S): `normals` as colours, or `shaded` grey."""
    normal, mask = pictures[:, :3], pictures[:, 3:4]
    if kind == "normals":
        return ((normal + mask) / 2).clamp(0, 1)
    grey = 0.1 * mask + 0.6 * normal[:, 2:3].clamp(min=0) + BACKGROUND * (1 - mask)
    return to_srgb(grey).clamp(0, 1).expand(-1, 3, -1, -1)
