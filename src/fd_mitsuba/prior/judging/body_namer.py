"""Which body a prior's sample shows, by a model that the prior was not trained with."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from fd_mitsuba.evaluation.clip import ClipJudge, cosines
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.judging.clip_evaluate import text_of
from fd_mitsuba.prior.pictures.clip_corpus import SIZE


class BodyNamer:
    """Names the body in views of normals, of all that the prior knows, by the sentences "a horse with wings", ...

    Args:
        judge: one that wants to see normals. The built-in evaluator has seen other seeds and captions than the prior.
    """

    def __init__(self, judge: ClipJudge) -> None:
        self._judge = judge
        self._texts: dict[str | None, Tensor] = {}

    def knows(self, body: str) -> bool:
        """Whether it can name that body at all."""
        return body in BODIES

    def __call__(self, views: np.ndarray, part: str | None) -> str:
        """The body whose sentence with `part` fits best.

        Args:
            views: (N, 3, H, W) of one object, in [0, 1].
        """
        if part not in self._texts:
            self._texts[part] = self._judge.texts([text_of(body, part) for body in BODIES])
        pictures = interpolate(torch.from_numpy(views).float(), size=(SIZE, SIZE), mode="bilinear")
        fit = cosines(self._judge.images(pictures), self._texts[part]).mean(0)
        return list(BODIES)[int(fit.argmax())]
