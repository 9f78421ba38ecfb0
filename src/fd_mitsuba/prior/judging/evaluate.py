"""What the geometry prior draws when it is asked directly: DDIM samples of parts on bodies, beside the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import ddim, sds
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.prior.pictures.corpus import Pair
from fd_mitsuba.prior.training.kinds import GEOMETRY, Kind

UNSEEN_SEED = 2**31
"""Bodies and parts of the evaluation come from seeds from here on; training draws its own below."""
KEPT_WITHIN = 0.15
_KEPT_SHARE = 0.95


@dataclass(frozen=True)
class SampleFigures:
    """Shares in [0, 1] over the samples of one part; None stands for prompts without a part.

    Attributes:
        body_kept: samples that leave at least 95 % of the body's pixels outside the true part as they are.
        overlap: mean intersection over union of what changed, in the sample and in truth. The truth is one of many
            right answers, so this is a comparison between trainings, not a score.
        held_out: whether combinations that training never showed are counted alone.
    """

    part: str | None
    held_out: bool
    count: int
    body_kept: float
    overlap: float


@network_threads()
@torch.no_grad()
def draw_samples(
    guidance: DiffusionGuidance,
    base: torch.Tensor,
    captions: list[str],
    seed: int,
    steps: int = 16,
    scale: float = 3.0,
    mask: torch.Tensor | None = None,
) -> torch.Tensor:
    """Clean latents (N, 4, 64, 64) after `steps` of DDIM, as a draft has them, given the base's latents and captions.

    Args:
        base: (N, C, 64, 64), the base's latents, after the region where the network is told it.
        mask: (N, 1, 64, 64) of zeros and ones: where noise is; elsewhere the picture is the base's, at every step.
    """
    seen, base = base, base[:, -4:]
    noise = torch.randn(base.shape, generator=torch.Generator().manual_seed(seed))
    passes = sds.cfg_coefficients_with_image(scale, 1.0)
    texts = guidance.embeddings(captions, passes)
    inside = torch.ones_like(base[:, :1]) if mask is None else mask

    def noise_in(z: torch.Tensor, now: torch.Tensor) -> torch.Tensor:
        z = torch.where(inside > 0, z, guidance.alpha_bars[now].sqrt().view(-1, 1, 1, 1) * base)
        return sds.combine(guidance.predict_noise(z, now, texts, Beside(seen)), passes)

    return torch.where(inside > 0, ddim.sample(noise_in, guidance.alpha_bars, noise, steps), base)


def seen_by(guidance: DiffusionGuidance, pair: Pair) -> np.ndarray:
    """(C, L, L) int8 what a prior sees of a pair beside the noise."""
    return pair.seen() if guidance.sees_region else pair.base


def evaluate(
    folder: Path,
    output: Path,
    bodies: list[str],
    parts: list[str],
    seed: int = 0,
    steps: int = 16,
    kind: Kind = GEOMETRY,
) -> list[SampleFigures]:
    """Write `output` (one row of truth and one of samples a body; overviews left, close-ups right) and measure.

    Args:
        folder: a packed pipeline folder.
        bodies, parts: names of the vocabulary.
        steps: of DDIM.
        kind: what the folder was trained as.

    Raises:
        UserError: a name outside the vocabulary.
    """
    check_names(bodies, parts, kind)
    known = list(kind.catalogue.body_weights)
    guidance = DiffusionGuidance.load(GuidanceConfig(model=str(folder), views_per_call=16))
    rows, judged = [], []
    for number, body in enumerate(bodies):
        pairs = kind.make_pairs(body, [*parts, None], UNSEEN_SEED + 1000 * seed + known.index(body))
        seen = torch.from_numpy(np.stack([seen_by(guidance, pair) for pair in pairs])).float() / 127
        sampled = draw_samples(guidance, seen, [pair.caption for pair in pairs], seed * 100 + number, steps)
        judged += [_judge(pair, latent.numpy()) for pair, latent in zip(pairs, sampled, strict=True)]
        order = sorted(range(len(pairs)), key=lambda i: pairs[i].closeup)
        truth = np.concatenate([picture(pairs[i].edited / 127.0) for i in order], axis=1)
        drawn = np.concatenate([picture(sampled[i].numpy()) for i in order], axis=1)
        rows += [truth, drawn]
    output.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(output)
    figures = []
    for part in (None, *parts):
        for held_out in (False, True):
            of_part = [j for p, b, j in judged if p == part and ((b, p) in kind.catalogue.held_out) == held_out]
            if of_part:
                kept, overlap = np.mean(of_part, axis=0)
                figures.append(SampleFigures(part, held_out, len(of_part), float(kept), float(overlap)))
    return figures


def _judge(pair: Pair, sample: np.ndarray) -> tuple[str | None, str, tuple[float, float]]:
    base, truth = pair.base / 127.0, pair.edited / 127.0
    changed, wanted = (_differs(latent, base) for latent in (sample, truth))
    union, kept = (changed | wanted).sum(), keeps_body(base, truth, sample)
    return pair.part, pair.body, (float(kept), float((changed & wanted).sum() / union) if union else 1.0)


def check_names(bodies: Sequence[str], parts: Sequence[str], kind: Kind = GEOMETRY) -> None:
    """UserError for a name outside the vocabulary."""
    there = kind.catalogue.body_weights, kind.catalogue.part_weights
    for name, known in [*((body, there[0]) for body in bodies), *((part, there[1]) for part in parts)]:
        if name not in known:
            raise UserError(f"{name!r}: no such name; known: {', '.join(known)}")


def keeps_body(base: np.ndarray, truth: np.ndarray, sample: np.ndarray, within: float = KEPT_WITHIN) -> bool:
    """Whether at least 95 % of the body's pixels that the true part leaves alone are as they were.

    Args:
        base, truth, sample: latents (4, H, W): the body, the body with the part, and what was drawn.
        within: how far the largest channel may be off.
    """
    body = body_pixels(base, truth)
    return bool((np.abs(sample - base).max(0) < within)[body].mean() > _KEPT_SHARE) if body.any() else True


def body_pixels(base: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Where (H, W) the body is and the true part is not."""
    return (base[3] > -0.5) & ~_differs(truth, base)


def _differs(latent: np.ndarray, base: np.ndarray) -> np.ndarray:
    return np.abs(latent - base).max(0) > 2 * KEPT_WITHIN


def colours(latents: np.ndarray) -> np.ndarray:
    """Colours (..., 3, H, W) in [0, 1] of geometry latents (..., 4, H, W): (n + 1) / 2 on black."""
    mask = (latents[..., 3:, :, :] + 1) / 2
    return np.clip((latents[..., :3, :, :] + mask) / 2, 0, 1)


def picture(latent: np.ndarray) -> np.ndarray:
    """The same of one latent as bytes (H, W, 3)."""
    return (colours(latent) * 255 + 0.5).astype(np.uint8).transpose(1, 2, 0)
