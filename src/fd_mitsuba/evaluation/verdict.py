"""Whether a grown part looks like what the prompt asks for, in the eyes of a judge that knows a list of parts.

    P(part) ~ mean over views of p(part | base, edited object)

over rings of views of the whole object and close-ups of the part, restricted to the parts that the prompt could ask for
and "nothing", and scaled to a sum of 1. Only views that show the part count. What the base has by itself (a cat's tail)
says nothing, since the judge sees each view before and after; a bare region or a lump is "nothing" to it. Bat wings
count for a prompt that asks for wings, and a top hat for one that asks for a hat, not the other way round. And the
prompt's part must be clearly likelier than it was at the start: a region like a wing that stayed is no wing. Of several
parts, each with a prompt of its own, each is judged by itself: the others are there before, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.for_model import BUILTIN_WIDE
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.before_and_after import before_and_after
from fd_mitsuba.evaluation.part_judge import (
    JUDGE_FOLDER,
    LEAST_PIXELS,
    PartJudge,
    changed_pixels,
    load_judge,
)
from fd_mitsuba.evaluation.part_judge import NOTHING as JUDGED_NOTHING
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.runs.scene_model import model_for_scene
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.training.geometry_stage import GeometryStage

NOTHING = "nothing"
LIKE, SURE = 0.5, 0.8
"""Least share of the prompt's part for "looks like", and for a verdict that ends a series of tries."""
JUDGE_NAME = "built-in judge of parts"
_LEAST_GAIN = 1.0
"""By how much the part's log odds must exceed those of the start."""
_SHOWN = 3


@dataclass(frozen=True)
class Verdict:
    """Attributes:
    part: what the prompt asks for.
    shares: the parts that the judge sees, and `NOTHING`, with their shares, largest first; they sum to 1.
    gain: log odds of the prompt's part, less those that the start has.
    views: how many views show the part.
    judge: who says so.
    """

    part: str
    shares: dict[str, float]
    gain: float
    views: int
    judge: str

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
        elif nearest == NOTHING:
            seen = f"like no part that the judge knows ({_share(self.shares[nearest])})"
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
            "judge": self.judge,
        }


@dataclass(frozen=True)
class Verdicts:
    """One on each of several parts, by the parts' names in the scene."""

    of_parts: dict[str, Verdict]

    @property
    def score(self) -> float:
        """Of the worst of them."""
        return min(verdict.score for verdict in self.of_parts.values())

    def line(self) -> str:
        """One line for people: "crown looks like: crown .91; wings looks like: wings .80"."""
        return "; ".join(f"{part} {verdict.line()}" for part, verdict in self.of_parts.items())

    def to_json(self) -> dict:
        """What `metrics.json` holds."""
        return {
            "looks_like": all(verdict.looks_like for verdict in self.of_parts.values()),
            "score": round(self.score, 4),
            "line": self.line(),
            "parts": {part: verdict.to_json() for part, verdict in self.of_parts.items()},
        }


def judge_part(
    stage: GeometryStage, judge: PartJudge, vocabulary: Vocabulary, name: str = JUDGE_NAME, of: str | None = None
) -> Verdict | None:
    """The verdict on a finished geometry stage; None where the prompt does not ask for one part that the judge knows.

    Args:
        vocabulary: the words in which the prompt is read, and the parts that it could have asked for.
        of: one of the scene's parts, which has a prompt of its own; None: all that grew, by the scene's prompt.
    """
    wanted = _wanted(stage.scene, vocabulary, of)
    parts = [part for part in vocabulary.parts if part in judge.classes]
    if wanted not in parts:
        return None
    edited, start = (list(before_and_after(stage, surface, of)) for surface in (stage.surface(), stage.start_surface()))
    (said, views), (begun, _) = (part_shares(judge, parts, pictures) for pictures in (edited, start))
    shares, before = (_with_kinds(dict(zip((*parts, NOTHING), found, strict=True)), wanted) for found in (said, begun))
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    return Verdict(wanted, dict(ranked), _log_odds(shares[wanted]) - _log_odds(before[wanted]), views, name)


def _with_kinds(shares: dict[str, float], wanted: str) -> dict[str, float]:
    """The shares, with those of the wanted part's kinds in its own: "bat wings" are "wings".

    >>> _with_kinds({"wings": 0.5, "bat wings": 0.25, "nothing": 0.25}, "wings")
    {'wings': 0.75, 'nothing': 0.25}
    """
    kinds = {name for name in shares if name.endswith(f" {wanted}")}
    own = shares[wanted] + sum(shares[name] for name in kinds)
    return {name: own if name == wanted else share for name, share in shares.items() if name not in kinds}


def can_be_judged(scene: EditScene, config: RunConfig) -> bool:
    """Whether the built-in judge can say if a run looks like its prompt: the prompt guides the shape, and asks for one
    part, in the judge's words, to be added, or has such a prompt for each of several.
    """
    vocabulary, judged = _words(model_for_scene(config, scene)[0]), vocabulary_of(BUILTIN_WIDE)
    if config.geometry.lambda_sds == 0 or scene.subtracts or vocabulary is None or judged is None:
        return False
    return all(_wanted(scene, vocabulary, of) in judged.parts for of in _judged_apart(scene) or [None])


def judge_run(geometry: GeometryStage, say: Callable[[str], None]) -> Verdict | Verdicts | None:
    """What the built-in judge says of a finished shape; None where it cannot be asked."""
    vocabulary = _words(geometry.config)
    if vocabulary is None or not can_be_judged(geometry.scene, geometry.config):
        return None
    try:
        judge, apart = load_judge(JUDGE_FOLDER), _judged_apart(geometry.scene)
        if not apart:
            return judge_part(geometry, judge, vocabulary)
        found = {part: judge_part(geometry, judge, vocabulary, of=part) for part in apart}
        return Verdicts({part: verdict for part, verdict in found.items() if verdict is not None})
    except UserError as error:
        say(f"no verdict on the part: {error}")
        return None


def part_shares(
    judge: PartJudge, parts: Sequence[str], pictures: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[list[float], int]:
    """Shares of `parts` and of nothing, which has all where no view shows any; and how many views show something.

    Args:
        parts: classes of the judge that may come out.
        pictures: sets of views (N, 4, 32, 32) before and after. Views with less than a third of their set's most
            changed pixels do not count.
    """
    said = []
    for before, after in pictures:
        changed = changed_pixels(before, after)
        chosen = (changed >= LEAST_PIXELS) & (changed >= changed.max() / 3)
        said.append(judge(before[chosen], after[chosen]))
    every = np.concatenate(said)
    if not len(every):
        return [*[0.0] * len(parts), 1.0], 0
    columns = [judge.classes.index(part) for part in (*parts, JUDGED_NOTHING)]
    shares = every[:, columns].astype(np.float64).mean(0)
    return (shares / max(shares.sum(), 1e-9)).tolist(), len(every)


def _words(config: RunConfig) -> Vocabulary | None:
    """The guidance model's own, or for a model that knows any word, those of the judge."""
    return vocabulary_of(config.guidance.model) or vocabulary_of(BUILTIN_WIDE)


def _judged_apart(scene: EditScene) -> list[str]:
    """The parts of a scene of several, where all have a prompt of their own; else none."""
    names = list(scene.parts)
    return names if len(names) > 1 and scene.told_apart else []


def _wanted(scene: EditScene, vocabulary: Vocabulary, of: str | None = None) -> str | None:
    prompt = scene.prompt if of is None else scene.part_prompts[of].prompt
    parts = read_prompt(prompt, vocabulary, scene.base_prompt).parts
    return parts[0] if len(parts) == 1 else None


def _log_odds(share: float) -> float:
    safe = min(max(share, 1e-9), 1 - 1e-9)
    return math.log(safe / (1 - safe))


def _share(value: float) -> str:
    return f"{value:.2f}".removeprefix("0")
