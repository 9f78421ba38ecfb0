"""How well an evaluator finds body and part in pictures of unseen seeds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from fd_mitsuba.evaluation.clip import ClipJudge, cosines
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.captions import BODY_WORDS, PART_WORDS
from fd_mitsuba.prior.data.clip_captions import ANY_STYLE, NO_PART
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.pictures.clip_corpus import UNSEEN_SEED, View, make_pictures

RING_VIEWS = 8
_BODY_NAMES, _PART_NAMES = list(BODIES), list(PARTS)
_COLUMNS = ("view", "ring", "body", "grown", "base_kept")


@dataclass(frozen=True)
class Retrieval:
    """Shares in [0, 1] of one part's pictures or objects (the mean of their views' similarities).

    `view` and `ring`: the part is first of the 16 on that body, by a single view in which it is seen and by the ring.
    `body`: the body is first of all with that part, by the ring. `grown`: the text with the part fits the ring better
    than the text without. `base_kept`: the same view without the part fits the plain text better.
    """

    count: int
    view: float
    ring: float
    body: float
    grown: float
    base_kept: float


def text_of(body: str, part: str | None) -> str:
    """The sentence that a user would write."""
    subject = f"a {BODY_WORDS[body][0]}"
    return subject if part is None else f"{subject} with {PART_WORDS[part][0]}"


def ring(rng: np.random.Generator) -> list[View]:
    """The cameras of the ring that runs are judged from: 45 degrees up, evenly spread, from any first azimuth."""
    first = rng.uniform(0, 2 * np.pi)
    half = 3.4 * np.tan(np.deg2rad(22.5))
    return [View.at(first + k * 2 * np.pi / RING_VIEWS, np.pi / 4, 3.4, half, np.zeros(3)) for k in range(RING_VIEWS)]


def report_lines(judge: ClipJudge, seed: int = 0) -> Iterator[str]:
    """For people: the figures by part and their means, of normals and of lit pictures."""
    for lit in (False, True):
        figures = retrieval(judge, lit=lit, seed=seed)
        yield f"{judge.name}, {'lit pictures' if lit else 'normals'}, {len(_BODY_NAMES)} unseen bodies"
        yield f"{'part':12} {'objects':>7} " + " ".join(f"{name:>9}" for name in _COLUMNS)
        for part, row in figures.items():
            yield f"{part:12} {row.count:7} " + " ".join(f"{getattr(row, name):9.1%}" for name in _COLUMNS)
        means = [np.mean([getattr(row, name) for row in figures.values()]) for name in _COLUMNS]
        yield f"{'mean':12} {'':7} " + " ".join(f"{mean:9.1%}" for mean in means)


def retrieval(
    judge: ClipJudge, bodies: list[str] | None = None, parts: list[str] | None = None, lit: bool = False, seed: int = 0
) -> dict[str, Retrieval]:
    """Figures by part, over one unseen object for each of the bodies.

    Args:
        lit: pictures in colour instead of normals; the texts name no colour.
    """
    bodies, parts = bodies or _BODY_NAMES, parts or _PART_NAMES
    plain = judge.texts([text_of(body, None) for body in _BODY_NAMES])
    texts = judge.texts([text_of(body, part) for body in _BODY_NAMES for part in _PART_NAMES])
    texts = texts.reshape(len(_BODY_NAMES), len(_PART_NAMES), -1)
    rows: dict[str, list[tuple[float, ...]]] = {part: [] for part in parts}
    for body in bodies:
        b = _BODY_NAMES.index(body)
        views = ring(np.random.default_rng([UNSEEN_SEED, seed, b]))
        pictures = make_pictures(body, parts, UNSEEN_SEED + seed, views)
        pictures = [p for p in pictures if (p.shown.body_style != ANY_STYLE) == lit]
        pixels = torch.from_numpy(np.stack([p.pixels for p in pictures])).permute(0, 3, 1, 2).float() / 255
        features, shown = judge.images(pixels), np.array([p.shown.part for p in pictures])
        # Every other camera shows ellipsoids instead of the plain body; both count as without a part.
        bare = cosines(features[shown == NO_PART], torch.cat([plain[b : b + 1], texts[b]]))
        for part in parts:
            p = _PART_NAMES.index(part)
            mine = features[shown == p]
            if not len(mine):
                continue
            on_body = cosines(mine, texts[b])
            whole = cosines(mine, torch.cat([texts[:, p], plain[b : b + 1]])).mean(0)
            rows[part].append(
                (
                    (on_body.argmax(1) == p).float().mean().item(),
                    float(on_body.mean(0).argmax() == p),
                    float(whole[:-1].argmax() == b),
                    float(whole[b] > whole[-1]),
                    (bare[:, 0] > bare[:, 1 + p]).float().mean().item(),
                )
            )
    return {part: Retrieval(len(found), *np.mean(found, axis=0).tolist()) for part, found in rows.items() if found}
