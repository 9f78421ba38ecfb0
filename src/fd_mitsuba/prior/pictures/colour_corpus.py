"""Colour mosaics to train the built-in prior on: a part in grey clay, and the same picture in the caption's colours.

The views are those of `corpus`: 2x2 of 32x32, four azimuths. Base and part are shaded as in `light`, with a material of
the base drawn at random and the same light for both pictures, so that they differ on the part alone. Pictures are sRGB
on black, as `guidance.colour_latents`. Parts are bent a little: those of a run are less regular than these.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.captions import BODY_WORDS, COLOURS, SYNONYM_WHOLES, caption, random_style, view_words
from fd_mitsuba.prior.data.looks import NATURAL, STYLE_OF_WORD, Material, named_look, random_body_look, zones
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.data.primitives import Solid
from fd_mitsuba.prior.pictures.colour_picture import Hits, mosaics, paint_hits, visible
from fd_mitsuba.prior.pictures.corpus import SUPERSAMPLING, MosaicCamera, Pair, RayCaster, closeup_camera, global_camera
from fd_mitsuba.prior.pictures.light import Light, lit_by, random_environment

STYLED_SHARE = 0.8
"""Captions that name a colour or material; the others get the part's natural look."""
PHRASES_WITH_COLOUR = ("plastic", "wooden", "ceramic", "stone")
"""Materials that may be named together with a colour: "a red plastic handle"."""
LOOKS_PER_CAMERA = 3
"""Pairs made from the same rays, with other materials, light and caption."""
BEND = 0.03
"""Largest shift of a part's points, as a share of its size."""


@dataclass(frozen=True)
class ColourPair(Pair):
    """A pair whose `base` is the picture with the part in clay; `part_coverage` (64, 64) uint8, 255 where it covers."""

    part_coverage: np.ndarray

    def changed(self) -> np.ndarray:
        return self.part_coverage > 25


@dataclass(frozen=True)
class PartView:
    """A part on a body as one mosaic of cameras sees it, ready to be painted."""

    part: str
    body: Solid
    solid: Solid
    camera: MosaicCamera
    closeup: bool
    hits: Hits

    def paint(
        self, look: tuple[Material, ...], adjective: str | None, light: Light, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Latents (4, 64, 64) int8 with the part in clay and in its look, and the part's coverage (64, 64) uint8.

        Args:
            look: one material, or one for each of the part's `zones`.
            adjective: a colour that the body must have; None: any. The same `rng` makes the same body, light and
                exposure for every look.
        """
        piece = self.hits.piece
        zone = np.zeros_like(piece) if len(look) == 1 else zones(self.part, piece, piece.max() + 1)
        paint = paint_hits(self.hits, self.body, self.solid, random_body_look(rng, adjective), look, zone, rng)
        return mosaics(self.hits, paint, light, rng)


def part_views(body: str, parts: list[str | None], rng: np.random.Generator) -> Iterator[PartView]:
    """Two views (global, close) a part of one random body, except those that show less than 20 pixels of the part.

    `None` among the parts, which `corpus.make_pairs` takes, gives no views.
    """
    made = BODIES[body](rng)
    base_caster, overview = RayCaster(made.solid), global_camera(rng)
    overview_rays = overview.rays()[:2]
    overview_base = base_caster.cast(*overview_rays)
    for part in filter(None, parts):
        solid = _bent(PARTS[part](made, rng), rng)
        caster, pieces = RayCaster(solid), pieces_of(solid)
        for camera, closeup in ((overview, False), (closeup_camera(solid, rng), True)):
            rays = camera.rays()[:2] if closeup else overview_rays
            hits = visible(rays, base_caster.cast(*rays) if closeup else overview_base, caster, pieces)
            if (hits.piece >= 0).sum() >= 20 * SUPERSAMPLING**2:
                yield PartView(part, made.solid, solid, camera, closeup, hits)


def make_colour_pairs(body: str, parts: list[str | None], seed: int) -> list[ColourPair]:
    """LOOKS_PER_CAMERA pairs for each of `part_views`; deterministic in (body, parts, seed)."""
    rng = np.random.default_rng([seed, list(BODIES).index(body)])
    lights, pairs = [lit_by(random_environment(rng)) for _ in range(2)], []
    for view in part_views(body, parts, rng):
        for _ in range(LOOKS_PER_CAMERA):
            text, adjective, named = colour_caption(body, view.part, rng)
            look = (named,) if named else NATURAL[view.part][rng.integers(len(NATURAL[view.part]))]
            base, edited, coverage = view.paint(look, adjective, lights[rng.integers(len(lights))], rng)
            azimuth = view.camera.azimuth_deg
            words = f"{text}, {view_words(azimuth, view.closeup)}"
            pairs.append(ColourPair(base, edited, words, body, view.part, azimuth, view.closeup, coverage))
    return pairs


def colour_caption(body: str, part: str, rng: np.random.Generator) -> tuple[str, str | None, Material | None]:
    """A caption, the colour that it gives the body, and the material that it gives the part (None: says nothing).

    A phrase that has a colour of its own ("a red cape") gets no second one.
    """
    style = ""
    if rng.random() < STYLED_SHARE:
        style = random_style(rng)
        if style in PHRASES_WITH_COLOUR and rng.random() < 0.3:
            style = f"{COLOURS[rng.integers(len(COLOURS))]} {style}"
    subjects = sorted((*BODY_WORDS[body], *SYNONYM_WHOLES.get((body, part), ())), key=len, reverse=True)
    while True:
        text = caption(body, part, rng, style)
        subject = next(word for word in subjects if f" {word}" in text)
        before, _, after = text.partition(f" {subject}")
        styles = [word for word in after.split() if word in STYLE_OF_WORD]
        if len(styles) == len([word for word in style.split() if word in STYLE_OF_WORD]) or not style:
            adjective = next((word for word in before.split() if word in COLOURS), None)
            return text, adjective, named_look(styles)


def _bent(solid: Solid, rng: np.random.Generator) -> Solid:
    """The solid under a smooth random shift of its points."""
    size = np.ptp(solid.vertices, axis=0).max()
    waves = rng.normal(size=(3, 3)) * (3.0 / size)
    shift = np.sin(solid.vertices @ waves + rng.uniform(0, 2 * np.pi, 3)) * (BEND * size * rng.random())
    return Solid(solid.vertices + shift @ np.linalg.qr(rng.normal(size=(3, 3)))[0], solid.faces)


def pieces_of(solid: Solid) -> np.ndarray:
    """For each face the number of its closed piece, in the order in which the pieces were joined."""
    start, count = solid.faces.ravel(), len(solid.vertices)
    edges = coo_array((np.ones(len(start)), (start, np.roll(solid.faces, -1, axis=1).ravel())), (count, count))
    return connected_components(edges, directed=False)[1][solid.faces[:, 0]]
