"""Training mosaics of the finer and the wide prior: parts added, taken away, and beside parts that stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fd_mitsuba.prior.data.body import Body
from fd_mitsuba.prior.data.captions import view_words
from fd_mitsuba.prior.data.fine.bodies import BODIES
from fd_mitsuba.prior.data.fine.captions import caption
from fd_mitsuba.prior.data.fine.parts import PARTS
from fd_mitsuba.prior.data.fine.placement import varied
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.parts import PARTS as PLAIN_PARTS
from fd_mitsuba.prior.data.parts import resized
from fd_mitsuba.prior.data.primitives import Solid, join, transform
from fd_mitsuba.prior.pictures.corpus import (
    REGION_STREAM,
    MosaicCamera,
    Pair,
    RayCaster,
    closeup_camera,
    global_camera,
    random_stretch,
    shade,
    told_region,
)
from fd_mitsuba.prior.pictures.corpus import VIEW_SIZE as PLAIN_VIEW_SIZE

VIEW_SIZE = 64
LEAST_PIXELS = 40
"""Of a mosaic that a part must change to be seen at all."""
REMOVED_SHARE = 0.1
"""Pairs the other way round: the body with the part is the condition, the bare body what is wanted."""
BESIDE_SHARE = 0.12
"""Pairs whose body wears another part, before and after."""
Hits = tuple[np.ndarray, np.ndarray]
Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
Grow = Callable[[str, Surface, np.random.Generator], Solid | None]


@dataclass(frozen=True)
class FinePair(Pair):
    """A pair of views of 64 pixels; latents are (4, 128, 128). `beside` names a part that both show."""

    beside: str | None = field(default=None, kw_only=True)

    def shows_part(self) -> bool:
        least = LEAST_PIXELS * (self.edited.shape[-1] / (2 * VIEW_SIZE)) ** 2
        return bool(self.changed().sum() >= least)


def stretched(body: Body, factors: np.ndarray) -> Body:
    """The body and its anchors, longer or shorter along the axes by `factors` (3,)."""
    across = float(np.sqrt(factors[0] * factors[2]))
    direction = factors * body.horn_direction
    return replace(
        body,
        solid=transform(body.solid, np.diag(factors)),
        head_top=factors * body.head_top,
        forehead=factors * body.forehead,
        back=factors * body.back,
        side=factors * body.side,
        horn_direction=direction / np.linalg.norm(direction),
        head_radius=across * body.head_radius,
        back_half_width=factors[0] * body.back_half_width,
        reach=float(np.prod(factors) ** (1 / 3)) * body.reach,
        side_height=factors[1] * body.side_height,
        bottom=factors[1] * body.bottom,
        foot_x=factors[0] * body.foot_x,
        foot_z=factors[2] * body.foot_z,
        foot_centre_z=factors[2] * body.foot_centre_z,
    )


def nearer(first: Hits, second: Hits) -> Hits:
    """What a ray sees of two solids."""
    closer = second[0] < first[0]
    return np.where(closer, second[0], first[0]), np.where(closer[:, None], second[1], first[1])


def grow_fine(part: str, surface: Surface, rng: np.random.Generator) -> Solid | None:
    """A part with detail, placed and sized with variety; None where its maker finds no place."""
    zones = PARTS[part](surface, rng)
    return varied(part, join(list(zones.values())), surface, rng) if zones else None


def grow_wide(part: str, surface: Surface, rng: np.random.Generator) -> Solid | None:
    """In half of the cases a part that the coarse makers know as they make it: plainer, for views of few pixels."""
    if part not in PLAIN_PARTS or rng.random() < 0.5:
        return grow_fine(part, surface, rng)
    return resized(part, PLAIN_PARTS[part](surface.body, rng), surface.body, rng)


def make_wide_pairs(body: str, parts: list[str | None], seed: int) -> list[FinePair]:
    """`make_fine_pairs` in views of 32 pixels, for the wide prior."""
    return make_fine_pairs(body, parts, seed, PLAIN_VIEW_SIZE, grow_wide)


def make_fine_pairs(
    body: str, parts: list[str | None], seed: int, view_size: int = VIEW_SIZE, grow: Grow = grow_fine
) -> list[FinePair]:
    """Two pairs (global, close) a part for one random body, deterministic in (body, parts, seed).

    Args:
        view_size: pixels of a view's side.
        grow: (part, surface, rng) -> that part's solid; None: it does not fit there.
    """
    rng = np.random.default_rng([seed, list(BODIES).index(body)])
    region_rng = np.random.default_rng([*REGION_STREAM, seed, list(BODIES).index(body)])
    surface = Surface(stretched(BODIES[body](rng), np.diag(random_stretch(rng))))
    overview = global_camera(rng)
    overview_rays = overview.rays(view_size)
    overview_hits = surface.caster.cast(*overview_rays[:2])
    pairs: list[FinePair] = []
    before: tuple[str, RayCaster] | None = None

    def add(
        camera: MosaicCamera, rays: Rays, base: Hits, grown: tuple[str, Solid, RayCaster] | None, closeup: bool
    ) -> None:
        part, solid, own = (None, None, None) if grown is None else grown
        beside = None
        if before is not None and before[0] != part and rng.random() < BESIDE_SHARE:
            beside, base = before[0], nearer(base, before[1].cast(*rays[:2]))
        edited = base if own is None else nearer(base, own.cast(*rays[:2]))
        removed = part is not None and rng.random() < REMOVED_SHARE
        words = f"{caption(body, part, rng, removed)}, {view_words(camera.azimuth_deg, closeup)}"
        first, second = (shade(*hits, rays[2], view_size) for hits in (base, edited))
        if removed:
            first, second = second, first
        region = told_region(solid, surface.body.solid, rays[0], rays[1], region_rng, view_size)
        view = camera.azimuth_deg, closeup
        pairs.append(FinePair(first, second, words, body, part, *view, removed=removed, beside=beside, region=region))

    for name in parts:
        solid = None if name is None else grow(name, surface, rng)
        if name is None or solid is None:
            add(overview, overview_rays, overview_hits, None, False)
            continue
        grown = name, solid, RayCaster(solid)
        add(overview, overview_rays, overview_hits, grown, False)
        near = closeup_camera(solid, rng)
        rays = near.rays(view_size)
        add(near, rays, surface.caster.cast(*rays[:2]), grown, True)
        before = name, grown[2]
    return pairs
