"""Whether a grown part looks like what the prompt asks for, in the eyes of a judge that knows a list of parts.

    P(part) ~ mean over views of p(part | base, edited object)

over rings of views of the whole object and close-ups of the part, restricted to the parts that the prompt could ask for
and "nothing", and scaled to a sum of 1. Only views that show the part count. What the base has by itself (a cat's tail)
says nothing, since the judge sees each view before and after; a bare region or a lump is "nothing" to it. Bat wings
count for a prompt that asks for wings, and a top hat for one that asks for a hat, not the other way round. And the
prompt's part must be clearly likelier than it was at the start: a region like a wing that stayed is no wing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.for_model import BUILTIN_WIDE
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.part_judge import (
    CAMERA_RADIUS,
    JUDGE_FOLDER,
    LEAST_PIXELS,
    VIEW_SIZE,
    PartJudge,
    changed_pixels,
    load_judge,
)
from fd_mitsuba.evaluation.part_judge import NOTHING as JUDGED_NOTHING
from fd_mitsuba.extraction.union_surface import UnionSurface
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.runs.scene_model import model_for_scene
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.geometry_stage import GeometryStage

NOTHING = "nothing"
LIKE, SURE = 0.5, 0.8
"""Least share of the prompt's part for "looks like", and for a verdict that ends a series of tries."""
JUDGE_NAME = "built-in judge of parts"
_VIEWS_A_RING, _ELEVATIONS_DEG, _SPP = 8, (15.0, 40.0), 16
_HALF_WIDTH = 1.25
"""Of a view of the whole object, canonical units; in the middle of what the judge was trained on."""
_CLOSE, _LEAST_HALF_WIDTH = 1.5, 0.3
"""Half width of a close-up, in radii of the part, and at least so wide; both as in the judge's training."""
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


def judge_part(
    stage: GeometryStage, judge: PartJudge, vocabulary: Vocabulary, name: str = JUDGE_NAME
) -> Verdict | None:
    """The verdict on a finished geometry stage; None where the prompt does not ask for one part that the judge knows.

    Args:
        vocabulary: the words in which the prompt is read, and the parts that it could have asked for.
    """
    wanted = _wanted(stage.scene, vocabulary)
    parts = [part for part in vocabulary.parts if part in judge.classes]
    if wanted not in parts:
        return None
    edited, start = (list(_pairs(stage, surface)) for surface in (stage.surface(), stage.start_surface()))
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
    part, in the judge's words, to be added.
    """
    vocabulary, judged = _words(model_for_scene(config, scene)[0]), vocabulary_of(BUILTIN_WIDE)
    if config.geometry.lambda_sds == 0 or scene.subtracts or vocabulary is None or judged is None:
        return False
    return _wanted(scene, vocabulary) in judged.parts


def judge_run(geometry: GeometryStage, say: Callable[[str], None]) -> Verdict | None:
    """What the built-in judge says of a finished shape; None where it cannot be asked."""
    vocabulary = _words(geometry.config)
    if vocabulary is None or not can_be_judged(geometry.scene, geometry.config):
        return None
    try:
        return judge_part(geometry, load_judge(JUDGE_FOLDER), vocabulary)
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


def _wanted(scene: EditScene, vocabulary: Vocabulary) -> str | None:
    parts = read_prompt(scene.prompt, vocabulary, scene.base_prompt).parts
    return parts[0] if len(parts) == 1 else None


@torch.no_grad()
def _pairs(stage: GeometryStage, surface: UnionSurface) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Views of the base and of a surface with a part: rings around the whole, then close-ups around the part."""
    part = surface.vertices[surface.part_weight > 0.5].double().numpy()
    frames = [(elevation, stage.aim, _HALF_WIDTH) for elevation in _ELEVATIONS_DEG]
    if len(part):
        low, high = part.min(0), part.max(0)
        half = np.clip(_CLOSE * np.linalg.norm(high - low) / 2, _LEAST_HALF_WIDTH, _HALF_WIDTH)
        frames.append((25.0, (low + high) / 2, float(half)))
    for elevation, target, half in frames:
        base, whole = (
            judged_views(which.vertices, which.faces, target, elevation, half)
            for which in (stage.base_surface, surface)
        )
        yield base, whole


def judged_views(
    vertices: torch.Tensor, faces: torch.Tensor, target: np.ndarray, elevation_deg: float, half_width: float
) -> np.ndarray:
    """A ring of views (8, 4, 32, 32) of a mesh as `PartJudge` takes them, the first from the front.

    Args:
        vertices, faces: (V, 3) canonical, (F, 3).
        target: (3,) what the cameras look at, canonical.
        half_width: of the view at the target, canonical units.
    """
    fov = 2 * np.degrees(np.arctan(half_width / CAMERA_RADIUS))
    turn = np.arange(_VIEWS_A_RING) * (360.0 / _VIEWS_A_RING)
    cameras = CameraBatch.around(turn, elevation_deg, CAMERA_RADIUS, fov, np.tile(target, (len(turn), 1)))
    rendering, weight = GeometryPass(VIEW_SIZE, _SPP, 0), torch.zeros(len(vertices))
    pictures = rendering.render_primal(vertices.float(), faces, weight, cameras, seed=0).numpy()
    return np.concatenate([pictures[:, :3], 2 * pictures[:, 3:4] - 1], axis=1)


def _log_odds(share: float) -> float:
    safe = min(max(share, 1e-9), 1 - 1e-9)
    return math.log(safe / (1 - safe))


def _share(value: float) -> str:
    return f"{value:.2f}".removeprefix("0")
