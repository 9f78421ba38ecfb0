"""Whether a grown part looks like what the prompt asks for, in the eyes of a judge that knows a list of parts.

    P(part) = softmax over the parts and "nothing" of
        SHARPNESS * scale * mean over views of ( cos(edited, t) - cos(base, t) / 2 - cos(start, t) / 2 )

with the sentences t "a cat with <part>" and "a cat", and the judge's own scale. What the base or the bare regions are
taken for by themselves (a cat's tail, a region like a wing) so counts little. Only views that show the part count. And
the prompt's part must be clearly likelier than it was at the start: a region like a wing that stayed is no wing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.clip import ClipJudge, cosines
from fd_mitsuba.evaluation.judged_views import RADIUS, shape_pictures
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.geometry_stage import GeometryStage

NOTHING = "nothing"
LIKE, SURE = 0.5, 0.8
"""Least share of the prompt's part for "looks like", and for a verdict that ends a series of tries."""
SHARPNESS = 1.5
"""With it 91 % of unseen true parts have a share of at least `LIKE`, and 7 % of bare starts (docs/evaluation.md)."""
_VIEWS_A_RING, _ELEVATIONS_DEG, _SIZE, _SPP = 12, (15.0, 45.0), 96, 9
_LEAST_SEEN = 20.0
"""Pixels of a view in which a part counts as seen."""
_LEAST_GAIN = 1.0
"""By how much the part's log odds must exceed those of the start; 97 % of the true parts' do."""
_SHOWN = 3


@dataclass(frozen=True)
class Verdict:
    """Attributes:
    part: what the prompt asks for.
    shares: the parts that the judge sees, and `NOTHING`, with their shares, largest first; they sum to 1.
    gain: log odds of the prompt's part, less those that the start has.
    views: how many views show the part.
    judge: who says so.
    version: of its weights.
    """

    part: str
    shares: dict[str, float]
    gain: float
    views: int
    judge: str
    version: str

    @property
    def share(self) -> float:
        """Of the prompt's part, in [0, 1]."""
        return self.shares.get(self.part, 0.0)

    @property
    def score(self) -> float:
        """The share, or less of it the less has changed since the start; in [0, 1]."""
        return self.share * min(max(self.gain / _LEAST_GAIN, 0.0), 1.0)

    @property
    def looks_like(self) -> bool:
        """Whether the prompt's part is what the judge sees."""
        return self.share >= LIKE and self.gain >= _LEAST_GAIN

    @property
    def sure(self) -> bool:
        """Whether it is so sure that no further try is needed."""
        return self.looks_like and self.share >= SURE

    def line(self) -> str:
        """One line for people: "looks like: crown .91, top hat .04"."""
        if self.looks_like:
            names = [self.part, *(name for name in self.shares if name != self.part and self.shares[name] >= 0.05)]
            return "looks like: " + ", ".join(f"{name} {_share(self.shares[name])}" for name in names[:_SHOWN])
        nearest = next(iter(self.shares))
        seen = f"nearest: {nearest} {_share(self.shares[nearest])}" if nearest != self.part else "the judge is unsure"
        if self.views == 0:
            seen = "no view shows it"
        elif self.share >= LIKE:
            seen = "it is still much as it started"
        return (
            f"does NOT look like {self.part} ({_share(self.share)}); {seen}; enlarge or move the region, or try "
            "another seed (--tries 3)"
        )

    def to_json(self) -> dict:
        """What `metrics.json` holds."""
        return {
            "part": self.part,
            "looks_like": self.looks_like,
            "score": round(self.score, 4),
            "line": self.line(),
            "shares": {name: round(share, 4) for name, share in self.shares.items() if share >= 0.005},
            "gain": round(self.gain, 3),
            "views": self.views,
            "judge": f"{self.judge} {self.version}",
        }


def judge_part(stage: GeometryStage, judge: ClipJudge, vocabulary: Vocabulary) -> Verdict | None:
    """The verdict on a finished geometry stage; None where the prompt does not ask for one part that the judge knows.

    Args:
        vocabulary: the parts and bodies that the judge can be asked for; those whose words it never saw are left out.
    """
    reading = read_prompt(stage.scene.prompt, vocabulary, stage.scene.base_prompt)
    parts = {name: phrases[0] for name, phrases in vocabulary.parts.items() if not judge.unknown_words(phrases[0])}
    if len(reading.parts) != 1 or reading.parts[0] not in parts:
        return None
    turn = np.arange(_VIEWS_A_RING) * (360.0 / _VIEWS_A_RING)
    kind = "normals" if judge.geometry_pictures == "normals" else "shaded"
    rings = [
        CameraBatch.around(turn, elevation, RADIUS, 45.0, np.tile(stage.aim, (len(turn), 1)))
        for elevation in _ELEVATIONS_DEG
    ]
    drawn = [shape_pictures(stage, cameras, _SIZE, _SPP, kind) for cameras in rings]
    edited, base, start = (
        judge.images(torch.cat([getattr(pictures, name) for pictures in drawn])) for name in ("edited", "base", "start")
    )
    seen = torch.cat([pictures.part_pixels for pictures in drawn])
    body = vocabulary.bodies[reading.bodies[0]][0] if reading.bodies else _body_of(judge, base, vocabulary)
    texts = judge.texts([*(f"a {body} with {phrase}" for phrase in parts.values()), f"a {body}"])
    shares = part_shares(edited, base, start, texts, seen, judge.scale)
    ranked = sorted(zip((*parts, NOTHING), shares, strict=True), key=lambda item: -item[1])
    own = list(parts).index(reading.parts[0])
    now, before = (part_shares(shown, base, base, texts, seen, judge.scale)[own] for shown in (edited, start))
    gain = _log_odds(now) - _log_odds(before)
    count = int((seen >= _LEAST_SEEN).sum())
    return Verdict(reading.parts[0], dict(ranked), gain, count, judge.name, judge.version)


def can_be_judged(scene: EditScene, config: RunConfig) -> bool:
    """Whether the built-in evaluator can say if a run looks like its prompt: the prompt guides the shape, and asks for
    one part, in the evaluator's words, to be added.
    """
    vocabulary = vocabulary_of("builtin")
    if config.geometry.lambda_sds == 0 or scene.subtracts or vocabulary is None:
        return False
    return len(read_prompt(scene.prompt, vocabulary, scene.base_prompt).parts) == 1


def judge_run(geometry: GeometryStage, say: Callable[[str], None]) -> Verdict | None:
    """What the built-in evaluator says of a finished shape; None where it cannot be asked."""
    vocabulary = vocabulary_of("builtin")
    if vocabulary is None or not can_be_judged(geometry.scene, geometry.config):
        return None
    try:
        return judge_part(geometry, ClipJudge.load(), vocabulary)
    except UserError as error:
        say(f"no verdict on the part: {error}")
        return None


def part_shares(
    edited: Tensor, base: Tensor, start: Tensor, texts: Tensor, seen: Tensor, scale: float
) -> Sequence[float]:
    """The formula above; the last text is the one without a part, and all of the share where no view shows any.

    Args:
        edited, base, start: features (N, D) of the same views.
        texts: (M, D).
        seen: (N,) pixels that the part covers. Views with less than a third of the most do not count.
        scale: what the judge's cosines were multiplied with in its training.
    """
    chosen = (seen >= _LEAST_SEEN) & (seen >= seen.max() / 3)
    if not chosen.any():
        return [*[0.0] * (len(texts) - 1), 1.0]
    after, *before = (cosines(features[chosen], texts).double().mean(0) for features in (edited, base, start))
    return torch.softmax(SHARPNESS * scale * (after - sum(before) / 2), 0).tolist()


def _body_of(judge: ClipJudge, base: Tensor, vocabulary: Vocabulary) -> str:
    """The body whose name fits the base's pictures best."""
    nouns = [phrases[0] for phrases in vocabulary.bodies.values()]
    return nouns[int(cosines(base, judge.texts([f"a {noun}" for noun in nouns])).mean(0).argmax())]


def _log_odds(share: float) -> float:
    safe = min(max(share, 1e-9), 1 - 1e-9)
    return math.log(safe / (1 - safe))


def _share(value: float) -> str:
    return f"{value:.2f}".removeprefix("0")
