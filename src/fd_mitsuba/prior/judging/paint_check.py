"""Guidance of colours in three dimensions, without a renderer: a texture field on a generated part, lit as in training.

Shows in a minute what the settings of the appearance stage do to a part's colour: the field is the run's own, the
guidance is the run's own, only the shading is that of `light`, with the roughness held fixed; the shine that the model
sees is the field's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.config.sections import TextureConfig
from fd_mitsuba.fields.texture import TextureField
from fd_mitsuba.guidance.colour_latents import shine
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import AppearanceViews
from fd_mitsuba.prior.data.looks import CLAY, NAMED, Pattern, cielab, random_body_look
from fd_mitsuba.prior.pictures.colour_picture import LUMINANCE, visible
from fd_mitsuba.prior.pictures.corpus import (
    SUPERSAMPLING,
    MosaicCamera,
    RayCaster,
    closeup_camera,
    global_camera,
)
from fd_mitsuba.prior.pictures.light import DIELECTRIC_F0, lit_by, lobes, random_environment, reflected
from fd_mitsuba.prior.training.kinds import APPEARANCE, Kind
from fd_mitsuba.render.tonemap import CLAY_LEVEL, to_srgb


@dataclass(frozen=True)
class Painted:
    """Mean of the part after painting: sRGB as seen, the anchor it is nearest to in CIELAB under the same light, and
    the field's base colour (sRGB), roughness and metallic; `speckle` is the base colour's standard deviation in CIELAB.

    `pictures` are mosaics (3, 2 H, 2 H) of one view, H pixels a side: clay, then after each quarter of the steps.
    """

    seen: tuple[float, ...]
    nearest: str
    base_color: tuple[float, ...]
    roughness: float
    metallic: float
    speckle: float
    pictures: list[np.ndarray] = field(repr=False)


class Easel:
    """One body with one part under one light, and the texture field that is painted on the part."""

    def __init__(
        self,
        body: str,
        part: str,
        seed: int,
        texture: TextureConfig | None = None,
        kind: Kind = APPEARANCE,
        view_size: int = 32,
    ) -> None:
        rng = np.random.default_rng([seed, 77])
        made = kind.catalogue.make_body(body, rng)
        self.solid = kind.catalogue.grow(made, part, rng).solid
        self._view_size = view_size
        self._casters = RayCaster(made.solid), RayCaster(self.solid)
        self._light = lit_by(random_environment(rng))
        self._look = Pattern(random_body_look(rng, None)[0], 1.8, rng)
        self._pieces = np.zeros(len(self.solid.faces), np.int64)
        self.roughness = 0.4
        self.camera = global_camera(rng)
        self.field = TextureField(texture or TextureConfig(levels=8, finest_resolution=128), seed)
        self._exposure = 1.0
        # As the appearance stage: by the light alone, the base in clay.
        hits = visible(*self._sight(self.camera))
        on_body, zone = hits.piece < 0, np.zeros(int((hits.piece < 0).sum()), np.int64)
        clay = np.full((len(zone), 3), CLAY.grey, np.float32)
        rough, metal = (np.array([v], np.float32) for v in (CLAY.roughness, CLAY.metallic))
        light = reflected(self._light, hits.normal[on_body], hits.to_viewer[on_body], zone, clay, rough, metal)
        self._exposure = CLAY_LEVEL / float(np.quantile(light @ LUMINANCE, 0.95))

    def _sight(self, camera: MosaicCamera) -> tuple:
        rays = camera.rays(self._view_size)[:2]
        return rays, self._casters[0].cast(*rays), self._casters[1], self._pieces

    def view(self, camera: MosaicCamera) -> EaselView:
        hits = visible(*self._sight(camera))
        on_part = hits.piece >= 0
        size = self._view_size * SUPERSAMPLING
        base, zone = np.zeros((4 * size * size, 3), np.float32), np.zeros(len(hits.pixel), np.int64)
        colour = self._look.colour(hits.point[~on_part])
        rough, metal = (np.array([v], np.float32) for v in (self._look.roughness, self._look.material.metallic))
        base[hits.pixel[~on_part]] = reflected(
            self._light, hits.normal[~on_part], hits.to_viewer[~on_part], zone[~on_part], colour, rough, metal
        )
        terms = [
            lobes(
                self._light, hits.normal[on_part], hits.to_viewer[on_part], zone[on_part], np.array([rough], np.float32)
            )
            for rough in (self.roughness, CLAY.roughness)
        ]
        return EaselView(
            torch.from_numpy(base * self._exposure),
            torch.from_numpy(hits.pixel[~on_part]),
            torch.from_numpy(hits.pixel[on_part]),
            torch.from_numpy(hits.point[on_part]),
            *(tuple(torch.from_numpy(term * self._exposure) for term in three) for three in terms),
            size=size,
        )


@dataclass(frozen=True)
class EaselView:
    """Supersampled pixels of four views, `size` a side; `terms` as `light.lobes`, for roughness of field and clay."""

    base: Tensor
    pixel_is_base: Tensor
    part_pixel: Tensor
    points: Tensor
    terms: tuple[Tensor, ...]
    clay_terms: tuple[Tensor, ...]
    size: int

    def picture(self, base_color: Tensor, metallic: Tensor, clay: bool = False) -> Tensor:
        """sRGB (4, 3, H, H) in [0, 1]. Gradients flow to the material (N, 3), (N, 1) of the part's pixels."""
        diffuse, tinted, white = self.clay_terms if clay else self.terms
        f0 = DIELECTRIC_F0 * (1 - metallic) + base_color * metallic
        radiance = base_color * (1 - metallic) * diffuse + f0 * tinted + white
        flat = self.base.index_copy(0, self.part_pixel, radiance)
        return to_srgb(flat).reshape(4, self.size, self.size, 3).permute(0, 3, 1, 2)

    def clay(self) -> Tensor:
        count = len(self.points)
        return self.picture(torch.full((count, 3), CLAY.grey), torch.zeros(count, 1), clay=True)

    def part_mask(self) -> Tensor:
        flat = torch.zeros(4 * self.size * self.size).index_fill(0, self.part_pixel, 1.0)
        return flat.reshape(4, 1, self.size, self.size)

    def shine(self, roughness: Tensor, metallic: Tensor) -> Tensor:
        flat = torch.zeros(4 * self.size * self.size).index_copy(0, self.part_pixel, shine(roughness, metallic)[:, 0])
        return flat.reshape(4, 1, self.size, self.size)

    def mask(self) -> Tensor:
        flat = self.part_mask().flatten().index_fill(0, self.pixel_is_base, 1.0)
        return flat.reshape(4, 1, self.size, self.size)


def paint(
    guidance: DiffusionGuidance,
    body: str,
    part: str,
    prompt: str,
    seed: int,
    steps: int,
    learning_rate: float = 0.01,
    kind: Kind = APPEARANCE,
) -> Painted:
    """Paint a part by `guide_appearance`, half of the steps close up, and look at the result."""
    easel = Easel(body, part, seed, kind=kind, view_size=guidance.appearance_size)
    guidance.set_prompt(prompt)
    optimiser = torch.optim.AdamW(easel.field.parameters(), lr=learning_rate, betas=(0.9, 0.99), eps=1e-15)
    fixed = easel.view(easel.camera)
    pictures = [_mosaic(fixed.clay())]
    for step in range(steps):
        rng = np.random.default_rng([seed, step])
        closeup = bool(rng.random() < 0.5)
        camera = closeup_camera(easel.solid, rng) if closeup else global_camera(rng)
        view = easel.view(camera)
        values = easel.field(view.points)
        views = AppearanceViews(
            view.picture(values.base_color, values.metallic),
            view.clay(),
            view.mask(),
            view.part_mask(),
            view.shine(values.roughness, values.metallic),
            [camera.azimuth_deg + 90 * k for k in range(4)],
            [camera.elevation_deg] * 4,
            closeup,
        )
        optimiser.zero_grad(set_to_none=True)
        guidance.guide_appearance(views, step, steps, seed).loss.backward()
        optimiser.step()
        if (step + 1) % max(steps // 4, 1) == 0:
            with torch.no_grad():
                values = easel.field(fixed.points)
                pictures.append(_mosaic(fixed.picture(values.base_color, values.metallic)))
    with torch.no_grad():
        values = easel.field(fixed.points)
        seen = _part_mean(fixed, values.base_color, values.metallic)
        anchors = {}
        for name, look in NAMED.items():
            pattern = Pattern(look, float(np.ptp(easel.solid.vertices, axis=0).max()), np.random.default_rng(seed))
            colour = torch.from_numpy(np.array(pattern.colour(fixed.points.numpy())))
            anchors[name] = _part_mean(fixed, colour, torch.full((len(colour), 1), look.metallic))
        distance = {
            name: float(np.linalg.norm(cielab(colour.numpy()) - cielab(seen.numpy())))
            for name, colour in anchors.items()
        }
        lab = cielab(to_srgb(values.base_color).numpy())
        return Painted(
            tuple(seen.tolist()),
            min(distance, key=distance.__getitem__),
            tuple(to_srgb(values.base_color.mean(0)).tolist()),
            float(values.roughness.mean()),
            float(values.metallic.mean()),
            float(np.sqrt(lab.var(0).sum())),
            pictures,
        )


def _part_mean(view: EaselView, base_color: Tensor, metallic: Tensor) -> Tensor:
    """Mean sRGB (3,) of the part's pixels."""
    picture = view.picture(base_color, metallic).permute(0, 2, 3, 1).reshape(-1, 3)
    return picture[view.part_pixel].mean(0)


def _mosaic(pictures: Tensor) -> np.ndarray:
    rows = [torch.cat([pictures[2 * k], pictures[2 * k + 1]], dim=2) for k in range(2)]
    return torch.cat(rows, dim=1).numpy()
