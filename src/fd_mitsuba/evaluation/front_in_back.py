"""The multi-face score: how often a judge takes a back view of the edited object for a view of the front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.evaluation.similarity import unit
from fd_mitsuba.scene.views import view_label

MOST_CONFUSION = 0.25
"""A judge that errs more often than this about the base itself cannot say anything about the edit."""


@dataclass(frozen=True)
class FrontInBack:
    """Attributes:
    share: of the edited object's back views, those that are nearer to the front of the base than to its back.
    base_share: the same of the base's own back views, each left out of the mean that it is compared with.
    confusion: share of the base's front and back views, left out likewise, that the judge takes for the other side.
    excess: `share - base_share`, the score; None where the confusion exceeds `MOST_CONFUSION`.
    """

    share: float
    base_share: float
    confusion: float
    excess: float | None


def front_in_back(edited: Tensor, base: Tensor, azimuth_deg: np.ndarray) -> FrontInBack | None:
    """The score of one ring of views; None where the ring has fewer than two views of the front or of the back.

    A front that the edit has put on the back, as SDS guidance may, makes back views look like front views. What looks
    like the front is learned from the base's own pictures, so no words for sides are needed: `e` is nearer to the front
    if `e . mean(front) > e . mean(back)` for unit features.

    Args:
        edited, base: (N, D) features of equal views.
        azimuth_deg: (N,) 0 sees the front; front and back are within 45 degrees of 0 and 180.
    """
    labels = [view_label(float(azimuth)) for azimuth in azimuth_deg]
    front, back = ([i for i, label in enumerate(labels) if label == name] for name in ("front", "back"))
    if min(len(front), len(back)) < 2:
        return None
    edited, base = unit(edited), unit(base)
    sides = base[front], base[back]
    share = float((_lean(edited[back], *sides) > 0).double().mean())
    as_front = [_lean(base[[i]], sides[0], _without(base, back, i)) > 0 for i in back]
    as_back = [_lean(base[[i]], _without(base, front, i), sides[1]) <= 0 for i in front]
    base_share = float(torch.cat(as_front).double().mean())
    confusion = float(torch.cat(as_front + as_back).double().mean())
    return FrontInBack(share, base_share, confusion, share - base_share if confusion <= MOST_CONFUSION else None)


def _lean(rows: Tensor, front: Tensor, back: Tensor) -> Tensor:
    """Positive where a row is nearer to the front."""
    return rows @ (unit(front.mean(0)) - unit(back.mean(0)))


def _without(features: Tensor, rows: list[int], left_out: int) -> Tensor:
    return features[[row for row in rows if row != left_out]]
