"""Colour mosaics of the finer prior: views of 64 pixels, its bodies and parts, and a material for each zone of a part.

Painted as in `colour_corpus`; bodies are stretched and parts resized and moved as in `fine_corpus`, then bent.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from fd_mitsuba.prior.data.catalogue import FINE
from fd_mitsuba.prior.data.fine.bodies import BODIES
from fd_mitsuba.prior.data.fine.captions import caption
from fd_mitsuba.prior.data.fine.parts import PARTS
from fd_mitsuba.prior.data.fine.placement import varied
from fd_mitsuba.prior.data.fine.surface import Surface
from fd_mitsuba.prior.data.primitives import join
from fd_mitsuba.prior.pictures.colour_corpus import ColourPair, PartView, Said, bent, painted_pairs, styled_caption
from fd_mitsuba.prior.pictures.colour_picture import visible
from fd_mitsuba.prior.pictures.corpus import SUPERSAMPLING, RayCaster, closeup_camera, global_camera, random_stretch
from fd_mitsuba.prior.pictures.fine_corpus import VIEW_SIZE, stretched

LEAST_PIXELS = 60
"""Of a mosaic that a part must cover to show its colours."""
_LINK = re.compile(r" (?:with|that has|wearing|standing on|on|riding) ")
"""What a caption has between the body and the part. The body's words do not tell: "something with dragon wings"."""


def make_fine_colour_pairs(body: str, parts: list[str | None], seed: int) -> list[ColourPair]:
    """Latents (4, 128, 128): `colour_corpus.painted_pairs` of `fine_part_views`; follows from (body, parts, seed)."""
    rng = np.random.default_rng([seed, list(BODIES).index(body)])
    return painted_pairs(body, fine_part_views(body, parts, rng), fine_colour_caption, FINE.natural, rng)


def fine_part_views(
    body: str, parts: list[str | None], rng: np.random.Generator, view_size: int = VIEW_SIZE
) -> Iterator[PartView]:
    """Two views (global, close) a part of one random body, except those that show less than LEAST_PIXELS of the part.

    `None` among the parts, and parts that find no place on the body, give no views.

    Args:
        view_size: pixels a side; the least number goes with the area.
    """
    least = LEAST_PIXELS * (SUPERSAMPLING * view_size / VIEW_SIZE) ** 2
    surface = Surface(stretched(BODIES[body](rng), np.diag(random_stretch(rng))))
    overview = global_camera(rng)
    overview_rays = overview.rays(view_size)[:2]
    overview_base = surface.caster.cast(*overview_rays)
    for part in filter(None, parts):
        zones = list(PARTS[part](surface, rng).values())
        if not zones:
            continue
        solid = bent(varied(part, join(zones), surface, rng), rng)
        # Resizing, moving and bending keep the order of the faces, so zones can go by it, without the closed pieces.
        caster, zone_of_face = RayCaster(solid), np.repeat(np.arange(len(zones)), [len(zone.faces) for zone in zones])
        for camera, closeup in ((overview, False), (closeup_camera(solid, rng), True)):
            rays = camera.rays(view_size)[:2] if closeup else overview_rays
            hits = visible(rays, surface.caster.cast(*rays) if closeup else overview_base, caster, zone_of_face)
            if (hits.piece >= 0).sum() >= least:
                yield PartView(part, surface.body.solid, solid, camera, closeup, hits, hits.piece, view_size)


def fine_colour_caption(body: str, part: str, rng: np.random.Generator) -> Said:
    """What a caption of the finer prior's says; none is of a removal, which has no colours."""

    def halves(text: str) -> tuple[str, str]:
        before, *after = _LINK.split(text, maxsplit=1)
        return before, after[0] if after else ""

    return styled_caption(lambda style: caption(body, part, rng, style=style), halves, rng)
