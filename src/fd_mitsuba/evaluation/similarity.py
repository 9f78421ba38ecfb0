"""How well pictures of an edit agree with sentences: CLIP_sim, CLIP_dir, and which sentence a judge would choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from fd_mitsuba.evaluation.clip import clip_direction, cosines


class Judge(Protocol):
    """A model that puts pictures and sentences into one space; `evaluation.clip.ClipJudge`."""

    name: str
    version: str
    """Of its weights."""
    geometry_pictures: str
    """What it wants to see of a shape without colours: `normals` or `shaded`."""

    def images(self, pictures: Tensor) -> Tensor:
        """(N, D) features of pictures (N, 3, H, W), sRGB in [0, 1]."""
        ...

    def texts(self, texts: list[str]) -> Tensor:
        """(N, D) features of sentences."""
        ...


@dataclass(frozen=True)
class EditPrompt:
    """What an edit asks for, and what was there before ("" if nobody says)."""

    prompt: str
    base_prompt: str = ""


def clip_scores(judge: Judge, edited: Tensor, base: Tensor, words: EditPrompt) -> dict[str, float]:
    """Means over the views of one edit; the keys are CLIP's scores as the paper and others define them.

    `sim` is the mean cosine of the edited views with the prompt; `sim_base` the same of the base's views. With a base
    prompt, `dir_dot` and `dir_cosine` compare the change of the pictures with the change of the texts: see
    `clip.clip_direction`. Paper: supplement, "Evaluation Protocol".

    Args:
        edited, base: (N, D) features of the same views.
    """
    texts = judge.texts([words.prompt, words.base_prompt or words.prompt])
    scores = {
        "sim": float(cosines(edited, texts[:1]).mean()),
        "sim_base": float(cosines(base, texts[:1]).mean()),
    }
    if words.base_prompt:
        direction = clip_direction(edited, base, texts[0], texts[1])
        scores |= {"dir_dot": float(direction.dot.mean()), "dir_cosine": float(direction.cosine.mean())}
    return scores


def retrieval(judge: Judge, edited: Tensor, base: Tensor, candidates: Sequence[EditPrompt], own: int) -> dict:
    """Where the judge places the edit's own sentence among candidates; 1 is the first.

    `rank` sorts by mean similarity of the views (N, D) with the prompts: it asks for the whole sentence, and the base
    alone may answer it. `rank_dir` sorts by the mean dot product of the change of the pictures with the change from a
    candidate's base prompt to its prompt: it asks for the part. `first_views` is the share of single views in which the
    own prompt is the most similar one.
    """
    texts = judge.texts([text for words in candidates for text in (words.prompt, words.base_prompt or words.prompt)])
    prompts, bases = texts[0::2], texts[1::2]
    per_view = cosines(edited, prompts)
    found = {
        "candidates": len(candidates),
        "rank": rank_of(per_view.mean(0).tolist(), own),
        "first_views": float((per_view.argmax(1) == own).double().mean()),
    }
    if all(words.base_prompt for words in candidates):
        rows = zip(prompts, bases, strict=True)
        agreement = [float(clip_direction(edited, base, text, before).dot.mean()) for text, before in rows]
        found["rank_dir"] = rank_of(agreement, own)
    return found


def rank_of(scores: Sequence[float], own: int) -> int:
    """Place of candidate `own` when all are sorted by falling score; 1 is the first. Ties go against it."""
    return 1 + sum(score >= scores[own] for index, score in enumerate(scores) if index != own)


def unit(features: Tensor) -> Tensor:
    """The rows at length 1, in double precision: differences of nearly equal features are what counts here."""
    features = features.detach().double()
    return features / torch.linalg.vector_norm(features, dim=-1, keepdim=True).clamp(min=1e-12)
