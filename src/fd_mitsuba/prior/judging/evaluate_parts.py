"""Does the shape prior draw what the prompt says? Samples of parts on unseen bodies, judged by an apart classifier."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.evaluation.part_judge import LEAST_PIXELS, NOTHING, PartJudge, changed_pixels
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.prior.data.captions import PART_WORDS
from fd_mitsuba.prior.judging.body_namer import BodyNamer
from fd_mitsuba.prior.judging.evaluate import (
    KEPT_WITHIN,
    UNSEEN_SEED,
    body_pixels,
    check_names,
    colours,
    draw_samples,
    keeps_body,
    picture,
    seen_by,
)
from fd_mitsuba.prior.judging.single_views import seen_by_judge, views_of
from fd_mitsuba.prior.pictures.corpus import Pair
from fd_mitsuba.prior.training.kinds import GEOMETRY, Kind

PLAIN_PROMPTS = 3
"""Prompts without a part for each body."""
LEAST_RECALL, LEAST_RECALL_OF_A_PART, LEAST_KEPT, LEAST_UNCHANGED = 0.85, 0.60, 0.95, 0.97
_UNCHANGED_SHARE = 0.01
_SHAPE_WITHIN, _TAKEN_SHARE = 0.5, 0.9


@dataclass(frozen=True)
class JudgedSample:
    """One sampled mosaic.

    Attributes:
        part: what the caption names; None: nothing.
        found: whether the classifier's mean over the views that show the part in truth says so; without a part,
            whether it says `none`. None where no view shows it, or without a classifier.
        found_in_truth: the same for the picture that the corpus has: what the classifier can tell at all.
        views_found: share of those views in which it says so.
        body_named: whether another model, not trained with the prior, still names the right body by the mean over the
            views. None for views centred on the part, or without such a model.
        body_named_in_truth: the same for the picture that the corpus has.
        body_kept: see `evaluate.keeps_body`; within 0.15, which a shift in shading already breaks.
        body_kept_in_truth: the same for another part of the same name, the corpus' own: one that is larger, or sits
            elsewhere, covers pixels that count as the body's. None for views centred on the part.
        shape_kept: as `body_kept` with 0.5, half the length of a normal: nothing of the body is gone or replaced.
        body_error: mean of the largest channel's difference over those pixels.
        unchanged: at most 1 % of the pixels differ from the base.
        taken_off: for a prompt that takes the part away, whether 90 % of its pixels are as they are without it.
    """

    body: str
    part: str | None
    closeup: bool
    held_out: bool
    found: bool | None
    found_in_truth: bool | None
    views_found: float | None
    body_named: bool | None
    body_named_in_truth: bool | None
    body_kept: bool
    body_kept_in_truth: bool | None
    shape_kept: bool
    body_error: float
    unchanged: bool
    taken_off: bool | None = None


def evaluate_parts(
    folder: Path,
    output: Path,
    judge: PartJudge | None,
    bodies: Sequence[str],
    parts: Sequence[str],
    seed: int = 0,
    steps: int = 16,
    scale: float = 2.0,
    closeups: bool = True,
    namer: BodyNamer | None = None,
    say: Callable[[str], None] = lambda line: None,
    kind: Kind = GEOMETRY,
) -> dict:
    """Sample, judge, and write the sheet `output` (a row of truth and one of samples a body) and `output`.json.

    Args:
        folder: a packed pipeline folder of the shape prior.
        judge: None leaves recall out.
        bodies, parts: names of the vocabulary; every pair that makes sense is sampled.
        steps, scale: of DDIM, and of the text guidance.
        closeups: also the views that are centred on the part.
        namer: None leaves out whether the body is still named right.
        say: takes a line a body.
        kind: what the folder was trained as. Parts and bodies that judge or namer do not know are not judged by them.

    Returns:
        What the JSON file holds; see `summary`.

    Raises:
        UserError: a name outside the vocabulary.
    """
    check_names(bodies, parts, kind)
    guidance = DiffusionGuidance.load(GuidanceConfig(model=str(folder), views_per_call=16))
    rows: list[list[np.ndarray]] = []
    judged: list[JudgedSample] = []
    for body in bodies:
        number = list(kind.catalogue.body_weights).index(body)
        body_seed = UNSEEN_SEED + 1000 * seed + number
        own_parts = [part for part in parts if kind.catalogue.suits(body, part)]
        pairs = list(kind.make_pairs(body, [*own_parts, *[None] * PLAIN_PROMPTS], body_seed))
        pairs = sorted((p for p in pairs if closeups or not p.closeup), key=lambda p: p.closeup)
        # The same body and overview again, whose second parts of each name are others.
        again = [p for p in kind.make_pairs(body, [*own_parts, *own_parts], body_seed) if not p.closeup]
        others: dict[str | None, Pair] = {p.part: p for p in again[len(own_parts) :] if not p.removed}
        seen = torch.from_numpy(np.stack([seen_by(guidance, pair) for pair in pairs])).float() / 127
        captions = [pair.caption for pair in pairs]
        samples = draw_samples(guidance, seen, captions, seed * 100 + number, steps, scale).numpy()
        of_body = [
            judge_sample(
                pair,
                sample,
                judge,
                None if pair.closeup else others.get(pair.part),
                namer,
                kind,
            )
            for pair, sample in zip(pairs, samples, strict=True)
        ]
        judged += of_body
        rows += [[picture(pair.edited / 127.0) for pair in pairs], [picture(sample) for sample in samples]]
        found = [sample.found for sample in of_body if sample.part and sample.found is not None]
        say(f"{body}: {len(of_body)} samples" + (f", part found in {np.mean(found):.0%}" if found else ""))
    output.parent.mkdir(parents=True, exist_ok=True)
    _sheet(rows).save(output)
    report = {
        "conditions": {"folder": str(folder), "seed": seed, "steps": steps, "scale": scale, "closeups": closeups},
        **summary(judged),
        "samples": [asdict(sample) for sample in judged],
    }
    write_atomically(output.with_suffix(".json"), (json.dumps(report, indent=1) + "\n").encode())
    return report


def _sheet(rows: Sequence[Sequence[np.ndarray]]) -> Image.Image:
    """The rows below each other, short ones filled with black: not every part finds a place on every body."""
    longest = max(len(row) for row in rows)
    return Image.fromarray(
        np.concatenate(
            [np.concatenate([*row, *[np.zeros_like(row[0])] * (longest - len(row))], axis=1) for row in rows]
        )
    )


def judge_sample(
    pair: Pair,
    sample: np.ndarray,
    judge: PartJudge | None,
    other: Pair | None = None,
    namer: BodyNamer | None = None,
    kind: Kind = GEOMETRY,
) -> JudgedSample:
    """What is said of one sampled mosaic (4, L, L); `other` is the same view with another such part."""
    base, truth = (latent.astype(np.float32) / 127 for latent in (pair.base, pair.edited))
    before, after, wanted = (seen_by_judge(views_of(mosaic[None])) for mosaic in (base, sample, truth))
    found = in_truth = share = None
    shown = changed_pixels(before, wanted) >= LEAST_PIXELS if pair.part else np.ones(len(before), bool)
    if judge is not None and shown.any() and not pair.removed and (pair.part or NOTHING) in judge.classes:
        label = judge.classes.index(pair.part or NOTHING)
        drawn, ideal = (judge(before[shown], views[shown]) for views in (after, wanted))
        found, in_truth = (bool(said.mean(0).argmax() == label) for said in (drawn, ideal))
        share = float((drawn.argmax(1) == label).mean())
    unchanged = float((np.abs(sample - base).max(0) > 0.3).mean()) <= _UNCHANGED_SHARE
    held_out = (pair.body, pair.part) in kind.catalogue.held_out
    kept, shape = (keeps_body(base, truth, sample, within) for within in (KEPT_WITHIN, _SHAPE_WITHIN))
    in_truth_kept = None if other is None else keeps_body(base, truth, other.edited.astype(np.float32) / 127)
    named = named_in_truth = None
    if (
        namer is not None
        and not pair.closeup
        and namer.knows(pair.body)
        and (pair.part is None or pair.part in PART_WORDS)
    ):
        named, named_in_truth = (namer(colours(views), pair.part) == pair.body for views in (after, wanted))
    body = body_pixels(base, truth)
    error = round(float(np.abs(sample - base).max(0)[body].mean()), 4) if body.any() else 0.0
    gone = None
    if pair.removed:
        gone = bool((np.abs(sample - truth).max(0) < _SHAPE_WITHIN)[pair.changed()].mean() > _TAKEN_SHARE)
    return JudgedSample(
        pair.body, None if pair.removed else pair.part, pair.closeup, held_out,
        found, in_truth, share, named, named_in_truth,
        kept, in_truth_kept, shape, error, unchanged, gone,
    )  # fmt: skip


def summary(samples: Sequence[JudgedSample]) -> dict:
    """Shares over samples: per part, over all, of combinations kept out of training; and the bars that are met.

    A `recall` is the share with `found`, `recall_in_truth` that with `found_in_truth`. None: nothing to count.
    """

    def shares(chosen: list[JudgedSample]) -> dict:
        return {
            "samples": len(chosen),
            "recall": _mean([s.found for s in chosen]),
            "recall_in_truth": _mean([s.found_in_truth for s in chosen]),
            "recall_of_views": _mean([s.views_found for s in chosen]),
            "body_named": _mean([s.body_named for s in chosen]),
            "body_named_in_truth": _mean([s.body_named_in_truth for s in chosen]),
            "body_kept": _mean([s.body_kept for s in chosen]),
            "body_kept_in_truth": _mean([s.body_kept_in_truth for s in chosen]),
            "shape_kept": _mean([s.shape_kept for s in chosen]),
            "body_error": _mean([s.body_error for s in chosen]),
        }

    with_part = [s for s in samples if s.part]
    plain = [s for s in samples if s.part is None and s.taken_off is None]
    removals = [s for s in samples if s.taken_off is not None]
    per_part = {
        part: shares([s for s in with_part if s.part == part]) for part in dict.fromkeys(s.part for s in with_part)
    }
    overall = shares(with_part)
    unchanged = _mean([s.unchanged for s in plain])
    recalls = [row["recall"] for row in per_part.values() if row["recall"] is not None]
    bars = {
        "recall": (overall["recall"], LEAST_RECALL),
        "recall of the weakest part": (min(recalls, default=None), LEAST_RECALL_OF_A_PART),
        "body named": (overall["body_named"], LEAST_KEPT),
        "body kept pixel by pixel": (overall["body_kept"], LEAST_KEPT),
        "unchanged without a part": (unchanged, LEAST_UNCHANGED),
    }
    return {
        "overall": overall,
        "overview": shares([s for s in with_part if not s.closeup]),
        "closeup": shares([s for s in with_part if s.closeup]),
        "held_out": shares([s for s in with_part if s.held_out]),
        "plain": {
            "samples": len(plain),
            "unchanged": unchanged,
            "judged_none": _mean([s.found for s in plain]),
            "shape_kept": _mean([s.shape_kept for s in plain]),
            "body_error": _mean([s.body_error for s in plain]),
        },
        "removal": {"samples": len(removals), "taken_off": _mean([s.taken_off for s in removals])},
        "per_part": per_part,
        "bars": {
            name: {"measured": value, "least": least, "met": None if value is None else value >= least}
            for name, (value, least) in bars.items()
        },
    }


def _mean(values: Sequence[bool | float | None]) -> float | None:
    known = [float(value) for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None
