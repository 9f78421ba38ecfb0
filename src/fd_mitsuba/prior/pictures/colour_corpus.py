"""Colour mosaics to train the built-in prior on: a part in grey clay, and the same picture in the caption's colours.

The views are those of `corpus`: 2x2 of 32x32, four azimuths. Base and part are shaded as in `light`, with a material of
the base drawn at random and the same light for both pictures, so that they differ on the part alone. Pictures are sRGB
on black, as `guidance.colour_latents`. Parts are bent a little: those of a run are less regular than these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
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
from fd_mitsuba.prior.pictures.corpus import (
    SUPERSAMPLING,
    VIEW_SIZE,
    MosaicCamera,
    Pair,
    RayCaster,
    closeup_camera,
    global_camera,
)
from fd_mitsuba.prior.pictures.light import Light, lit_by, random_environment

STYLED_SHARE = 0.8
"""Captions that name a colour or material; the others get the part's natural look."""
PHRASES_WITH_COLOUR = ("plastic", "wooden", "ceramic", "stone")
"""Materials that may be named together with a colour: "a red plastic handle"."""
LOOKS_PER_CAMERA = 3
"""Pairs made from the same rays, with other materials, light and caption."""
BEND = 0.03
"""Largest shift of a part's points, as a share of its size."""
LEAST_PIXELS = 20
"""Of a mosaic that a part must cover to show its colours."""
Said = tuple[str, str | None, Material | None]
"""A caption, the colour that it gives the body, and the material that it gives the part (None: says nothing)."""


@dataclass(frozen=True)
class ColourPair(Pair):
    """A pair whose `base` is the picture with the part in clay; `part_coverage` (L, L) uint8, 255 where it covers."""

    part_coverage: np.ndarray

    def changed(self) -> np.ndarray:
        return self.part_coverage > 25


@dataclass(frozen=True)
class PartView:
    """A part on a body as one mosaic of cameras sees it, ready to be painted.

    Attributes:
        zone: (N,) which of a natural look's materials each of the hits has; of no meaning on the base.
        view_size: side in pixels of one of the four views, which the hits are of.
    """

    part: str
    body: Solid
    solid: Solid
    camera: MosaicCamera
    closeup: bool
    hits: Hits
    zone: np.ndarray
    view_size: int = VIEW_SIZE

    def paint(
        self, look: tuple[Material, ...], adjective: str | None, light: Light, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Latents (4, L, L) int8 with the part in clay and in its look, and its coverage (L, L) uint8; L = 2 view_size.

        Args:
            look: one material, or one for each of the part's zones.
            adjective: a colour that the body must have; None: any. The same `rng` makes the same body, light and
                exposure for every look.
        """
        zone = np.zeros_like(self.zone) if len(look) == 1 else self.zone
        paint = paint_hits(self.hits, self.body, self.solid, random_body_look(rng, adjective), look, zone, rng)
        return mosaics(self.hits, paint, light, rng, self.view_size)


def part_views(body: str, parts: list[str | None], rng: np.random.Generator) -> Iterator[PartView]:
    """Two views (global, close) a part of one random body, except those that show less than LEAST_PIXELS of the part.

    `None` among the parts, which `corpus.make_pairs` takes, gives no views.
    """
    made = BODIES[body](rng)
    base_caster, overview = RayCaster(made.solid), global_camera(rng)
    overview_rays = overview.rays()[:2]
    overview_base = base_caster.cast(*overview_rays)
    for part in filter(None, parts):
        solid = bent(PARTS[part](made, rng), rng)
        caster, pieces = RayCaster(solid), pieces_of(solid)
        for camera, closeup in ((overview, False), (closeup_camera(solid, rng), True)):
            rays = camera.rays()[:2] if closeup else overview_rays
            hits = visible(rays, base_caster.cast(*rays) if closeup else overview_base, caster, pieces)
            if (hits.piece >= 0).sum() >= LEAST_PIXELS * SUPERSAMPLING**2:
                zone = zones(part, hits.piece, hits.piece.max() + 1)
                yield PartView(part, made.solid, solid, camera, closeup, hits, zone)


def make_colour_pairs(body: str, parts: list[str | None], seed: int) -> list[ColourPair]:
    """LOOKS_PER_CAMERA pairs for each of `part_views`; deterministic in (body, parts, seed)."""
    rng = np.random.default_rng([seed, list(BODIES).index(body)])
    return painted_pairs(body, part_views(body, parts, rng), colour_caption, NATURAL, rng)


def painted_pairs(
    body: str,
    views: Iterable[PartView],
    say: Callable[[str, str, np.random.Generator], Said],
    natural: Mapping[str, tuple[tuple[Material, ...], ...]],
    rng: np.random.Generator,
) -> list[ColourPair]:
    """LOOKS_PER_CAMERA pairs a view under one of two lights, which are drawn before the first view.

    Args:
        say: (body, part, rng) -> what a caption says.
        natural: the looks of each part whose colour a caption does not name.
    """
    lights, pairs = [lit_by(random_environment(rng)) for _ in range(2)], []
    for view in views:
        choices = natural[view.part]
        for _ in range(LOOKS_PER_CAMERA):
            text, adjective, named = say(body, view.part, rng)
            look = (named,) if named else choices[rng.integers(len(choices))]
            base, edited, coverage = view.paint(look, adjective, lights[rng.integers(len(lights))], rng)
            azimuth = view.camera.azimuth_deg
            words = f"{text}, {view_words(azimuth, view.closeup)}"
            pairs.append(ColourPair(base, edited, words, body, view.part, azimuth, view.closeup, coverage))
    return pairs


def colour_caption(body: str, part: str, rng: np.random.Generator) -> Said:
    """What a caption of the coarse prior's says."""
    subjects = sorted((*BODY_WORDS[body], *SYNONYM_WHOLES.get((body, part), ())), key=len, reverse=True)

    def halves(text: str) -> tuple[str, str]:
        subject = next(word for word in subjects if f" {word}" in text)
        before, _, after = text.partition(f" {subject}")
        return before, after

    return styled_caption(lambda style: caption(body, part, rng, style), halves, rng)


def styled_caption(
    write: Callable[[str], str], halves: Callable[[str], tuple[str, str]], rng: np.random.Generator
) -> Said:
    """A caption in a random style, or in none. A phrase that has a colour of its own ("a red cape") gets no second one.

    Args:
        write: style -> a random caption; the empty style is none.
        halves: caption -> its words about the body, and those about the part.
    """
    style = ""
    if rng.random() < STYLED_SHARE:
        style = random_style(rng)
        if style in PHRASES_WITH_COLOUR and rng.random() < 0.3:
            style = f"{COLOURS[rng.integers(len(COLOURS))]} {style}"
    while True:
        text = write(style)
        before, after = halves(text)
        styles = [word for word in after.split() if word in STYLE_OF_WORD]
        if len(styles) == len([word for word in style.split() if word in STYLE_OF_WORD]) or not style:
            adjective = next((word for word in before.split() if word in COLOURS), None)
            return text, adjective, named_look(styles)


def bent(solid: Solid, rng: np.random.Generator) -> Solid:
    """The solid under a smooth random shift of its points; their order and the faces stay."""
    size = np.ptp(solid.vertices, axis=0).max()
    waves = rng.normal(size=(3, 3)) * (3.0 / size)
    shift = np.sin(solid.vertices @ waves + rng.uniform(0, 2 * np.pi, 3)) * (BEND * size * rng.random())
    return Solid(solid.vertices + shift @ np.linalg.qr(rng.normal(size=(3, 3)))[0], solid.faces)


def pieces_of(solid: Solid) -> np.ndarray:
    """For each face the number of its closed piece, in the order in which the pieces were joined."""
    start, count = solid.faces.ravel(), len(solid.vertices)
    edges = coo_array((np.ones(len(start)), (start, np.roll(solid.faces, -1, axis=1).ravel())), (count, count))
    return connected_components(edges, directed=False)[1][solid.faces[:, 0]]
