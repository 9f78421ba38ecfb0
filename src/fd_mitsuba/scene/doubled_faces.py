"""Faces that a mesh holds twice, once each way round, as exporters of two-sided materials write them."""

from __future__ import annotations

import numpy as np


def without_reversed_copies(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces (F, 3) without those that have the corners of an earlier one the other way round.

    Together the two cancel in a winding number, and the piece that they make has no inside. Corners are the same where
    their positions are equal. Copies that run the same way stay.
    """
    hashes = _hashes(vertices + 0.0)
    keys = np.sort(hashes[faces].sum(axis=1))  # of three corners in any order
    if not (keys[1:] == keys[:-1]).any():
        return faces
    place = _labels(hashes)[faces]
    least = np.argmin(place, axis=1)[:, None]
    turned = np.take_along_axis(place, (least + np.arange(3)) % 3, axis=1)
    key, mirrored = turned, turned[:, [0, 2, 1]]
    low = np.where((turned[:, 1] < turned[:, 2])[:, None], key, mirrored)
    labels = _labels(_hashes(low))
    forward = turned[:, 1] < turned[:, 2]
    count = int(labels.max(initial=-1)) + 1
    both = (np.bincount(labels[forward], minlength=count) > 0) & (np.bincount(labels[~forward], minlength=count) > 0)
    if not both.any():
        return faces
    first = np.full(count, len(faces))
    np.minimum.at(first, labels, np.arange(len(faces)))
    proper = (place[:, 0] != place[:, 1]) & (place[:, 1] != place[:, 2]) & (place[:, 2] != place[:, 0])
    return faces[~proper | ~both[labels] | (forward == forward[first[labels]])]


def _labels(hashes: np.ndarray) -> np.ndarray:
    """(N,) the same number for equal hashes, in no order."""
    return np.unique(hashes, return_inverse=True)[1].reshape(-1)


def _hashes(rows: np.ndarray) -> np.ndarray:
    """(N,) uint64 of rows of three numbers of 64 bits: sorting whole rows takes ten times as long."""
    words = np.ascontiguousarray(rows).view(np.uint64)
    mixed = np.zeros(len(rows), dtype=np.uint64)
    for column in range(3):
        mixed = (mixed ^ words[:, column]) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed
