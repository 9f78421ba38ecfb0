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
LEAST_SEPARATION = 0.1
"""A base whose front and back differ by less in unit features, such as a vase, has no front that a part could double.
The shipped animals have 0.4 to 0.9, a mug and a snowman 0.25, the vase 0.05 (built-in evaluator, normals)."""


@dataclass(frozen=True)
class FrontInBack:
    """Attributes:
    share: of the edited object's back views, those that lean to the front.
    base_share: the same of the base's own back views, each left out of the mean that it is compared with.
    confusion: share of the base's front and back views, left out likewise, that the judge takes for the other side.
    separation: distance between the mean features of the base's front and back, as unit vectors.
    excess: `share - base_share`, the score; None where the confusion exceeds `MOST_CONFUSION`, or the separation is
        below `LEAST_SEPARATION`.
    """

    share: float
    base_share: float
    confusion: float
    separation: float
    excess: float | None


def front_in_back(edited: Tensor, base: Tensor, azimuth_deg: np.ndarray) -> FrontInBack | None:
    """The score of one ring of views; None where the ring has fewer than two views of the front or of the back.

    A front that the edit has put on the back, as SDS guidance may, makes back views look like front views. What looks
    like the front is learned from the base's own pictures, so no words for sides are needed. With the direction
    a = mean(front) - mean(back) of unit features, a view e leans by (e - m) . a, where m is the middle between front
    and back of the object that it shows: what an edit adds to every view alike, such as a round hat, says nothing about
    sides. A back view is mistaken if it leans to the front; where front and back look the same, half of them do.

    Args:
        edited, base: (N, D) features of equal views.
        azimuth_deg: (N,) 0 sees the front; front and back are within 45 degrees of 0 and 180.
    """
    labels = [view_label(float(azimuth)) for azimuth in azimuth_deg]
    front, back = ([i for i, label in enumerate(labels) if label == name] for name in ("front", "back"))
    if min(len(front), len(back)) < 2:
        return None
    edited, base = unit(edited), unit(base)
    mistaken = _leans_to_front(edited[back], (base[front], base[back]), (edited[front], edited[back]))
    as_front = [_leans_to_front(base[[i]], (base[front], _without(base, back, i))) for i in back]
    as_back = [~_leans_to_front(base[[i]], (_without(base, front, i), base[back])) for i in front]
    base_share = float(torch.cat(as_front).double().mean())
    confusion = float(torch.cat(as_front + as_back).double().mean())
    share = float(mistaken.double().mean())
    separation = float((unit(base[front].mean(0)) - unit(base[back].mean(0))).norm())
    tells = confusion <= MOST_CONFUSION and separation >= LEAST_SEPARATION
    return FrontInBack(share, base_share, confusion, separation, share - base_share if tells else None)


def _leans_to_front(rows: Tensor, base: tuple[Tensor, Tensor], own: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Which rows lean to the front.

    Args:
        base: features of the base's front, and of its back.
        own: of the object that `rows` show, if it is another one.
    """
    front, back = (side.mean(0) for side in base)
    axis = unit(front) - unit(back)
    middle = torch.cat([side.mean(0, keepdim=True) for side in own or base]).mean(0)
    return (rows - middle) @ axis > 0


def _without(features: Tensor, rows: list[int], left_out: int) -> Tensor:
    return features[[row for row in rows if row != left_out]]
