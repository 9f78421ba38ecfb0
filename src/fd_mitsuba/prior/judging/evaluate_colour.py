"""What the appearance prior paints on its own: sampled mosaics, and whether their colours are the prompted ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance.diffusion import MASK_THRESHOLD, DiffusionGuidance
from fd_mitsuba.prior.data.captions import MATERIALS, styled, view_words
from fd_mitsuba.prior.data.looks import NAMED, cielab
from fd_mitsuba.prior.judging.evaluate import UNSEEN_SEED, draw_samples
from fd_mitsuba.prior.pictures.colour_corpus import PartView, part_views
from fd_mitsuba.prior.pictures.fine_colour_corpus import fine_part_views
from fd_mitsuba.prior.pictures.light import Light, lit_by, random_environment
from fd_mitsuba.prior.training.kinds import APPEARANCE, APPEARANCE_FINE, Kind

_ON_PART = 128
"""Pixels that the part covers by half or more (of 255) are counted."""


@dataclass(frozen=True)
class ColourFigure:
    """One sample: which of the anchors, painted on the same part under the same light, its mean colour is nearest to.

    `error` is the distance in CIELAB to the prompted one.
    """

    body: str
    part: str
    style: str
    nearest: str
    error: float


def evaluate_colours(
    folder: Path,
    output: Path,
    cases: Sequence[tuple[str, str, str]],
    seed: int = 0,
    steps: int = 12,
    scale: float = 1.5,
    kind: Kind = APPEARANCE,
) -> list[ColourFigure]:
    """Write `output` (a row each of clay, truth, sample for twelve cases) and measure.

    Args:
        folder: a packed pipeline folder of the appearance prior.
        cases: (body, part, style); a style is a key of `NAMED`.
        steps, scale: of DDIM, and of the text guidance.
        kind: of colours, whose bodies and parts the cases name.
    """
    guidance = DiffusionGuidance.load(
        GuidanceConfig(model=str(folder), views_per_call=16), appearance=AppearanceConfig()
    )
    clay, truths, coverages, captions = [], [], [], []
    for number, (body, part, style) in enumerate(cases):
        rng = np.random.default_rng([UNSEEN_SEED, seed, number])
        light = lit_by(random_environment(rng))
        views = list(_views(kind, body, part, rng, guidance.appearance_size))
        view = views[number % len(views)]
        painted = {name: _painted(view, name, light, number) for name in NAMED}
        clay.append(painted[style][0])
        truths.append({name: picture[1] for name, picture in painted.items()})
        coverages.append(painted[style][2])
        captions.append(f"{prompt(body, part, style, kind)}, {view_words(view.camera.azimuth_deg, view.closeup)}")
    base = torch.from_numpy(np.stack(clay)).float() / 127
    # As the guidance works: noise on the part alone.
    mask = torch.from_numpy(np.stack(coverages)[:, None] > 255 * MASK_THRESHOLD).float()
    samples = torch.cat(
        [
            draw_samples(guidance, base[i : i + 8], captions[i : i + 8], seed + i, steps, scale, mask[i : i + 8])
            for i in range(0, len(base), 8)
        ]
    ).numpy()
    figures = []
    for case, truth, sample, coverage in zip(cases, truths, samples, coverages, strict=True):
        on_part = coverage >= _ON_PART
        means = {name: _mean_lab(latent / 127, on_part) for name, latent in truth.items()}
        drawn = _mean_lab(sample, on_part)
        nearest = min(means, key=lambda name: float(np.linalg.norm(means[name] - drawn)))
        figures.append(ColourFigure(*case, nearest, float(np.linalg.norm(means[case[2]] - drawn))))
    wanted = [truth[case[2]] / 127 for truth, case in zip(truths, cases, strict=True)]
    write_sheet(output, [[picture / 127 for picture in clay], wanted, list(samples)])
    return figures


def prompt(body: str, part: str, style: str, kind: Kind = APPEARANCE) -> str:
    """The plainest sentence for a body with a part in a style."""
    word = MATERIALS[style][0] if style in MATERIALS else style
    subject = kind.catalogue.body_words[body][0]
    return f"{'an' if subject[0] in 'aeiou' else 'a'} {subject} with {styled(kind.catalogue.part_words[part][0], word)}"


def colours(latent: np.ndarray) -> np.ndarray:
    """sRGB (H, W, 3) in [0, 1] of a latent (4, H, W)."""
    return np.clip((latent[:3] + 1) / 2, 0, 1).transpose(1, 2, 0)


def write_sheet(output: Path, rows: list[list[np.ndarray]], columns: int = 12, zoom: int = 2) -> None:
    """Write latents (4, L, L) as pictures, the rows under each other, `columns` to a line."""
    lines = []
    for start in range(0, len(rows[0]), columns):
        for row in rows:
            pictures = [colours(latent) for latent in row[start : start + columns]]
            pictures += [np.zeros_like(pictures[0])] * (columns - len(pictures))
            lines.append(np.concatenate(pictures, axis=1))
    sheet = Image.fromarray(np.rint(255 * np.concatenate(lines)).astype(np.uint8))
    output.parent.mkdir(parents=True, exist_ok=True)
    sheet.resize((sheet.width * zoom, sheet.height * zoom), Image.Resampling.NEAREST).save(output)


def _views(kind: Kind, body: str, part: str, rng: np.random.Generator, size: int) -> Iterator[PartView]:
    """Views of `size` pixels a side; the coarse prior has one size."""
    return fine_part_views(body, [part], rng, size) if kind is APPEARANCE_FINE else part_views(body, [part], rng)


def _painted(view: PartView, style: str, light: Light, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return view.paint((NAMED[style],), None, light, np.random.default_rng([UNSEEN_SEED, seed]))


def _mean_lab(latent: np.ndarray, where: np.ndarray) -> np.ndarray:
    return cielab(colours(latent)[where].mean(0))


def balanced_cases(count: int, seed: int = 0, kind: Kind = APPEARANCE) -> list[tuple[str, str, str]]:
    """`count` cases in which all styles, parts and bodies come about equally often, parts on bodies that suit."""
    rng, catalogue = np.random.default_rng(seed), kind.catalogue
    bodies, parts, styles = (
        [str(name) for _ in range(-(-count // len(names))) for name in rng.permutation(list(names))][:count]
        for names in (catalogue.body_weights, catalogue.part_weights, NAMED)
    )
    for k, part in enumerate(parts):
        wanted = next((j for j in range(k, count) if catalogue.suits(bodies[j], part)), None)
        if wanted is None:
            fitting = [body for body in catalogue.body_weights if catalogue.suits(body, part)]
            bodies[k] = str(rng.choice(fitting))
        else:
            bodies[k], bodies[wanted] = bodies[wanted], bodies[k]
    return list(zip(bodies, parts, styles, strict=True))
