"""The frame that a field's normal perturbation refers to: a function of the smooth normal alone, without UVs."""

from __future__ import annotations

import numpy as np

REFERENCE_AXIS = (0.30, 0.80, 0.52)
"""Not along an axis: the frame has its one singular direction opposite to it, where no flat side should lie."""

SINGULAR = 1e-4
"""Within this of the singular direction (1 + cosine) the frame stays as the reference has it."""


def reference_frame() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The orthonormal frame (tangent, bitangent, axis), (3,) each, that is turned to meet a normal."""
    axis = np.array(REFERENCE_AXIS) / np.linalg.norm(REFERENCE_AXIS)
    tangent = np.array([1.0, 0.0, 0.0])
    tangent -= (tangent @ axis) * axis
    tangent /= np.linalg.norm(tangent)
    return tangent, np.cross(axis, tangent), axis


def tangent_frame(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tangent and bitangent (N, 3): the reference frame under the smallest rotation that takes its axis to the normal.

    With h = axis + normal, a vector v orthogonal to the axis goes to v - h (v . normal) / (1 + axis . normal).
    Right-handed (tangent x bitangent = normal) and smooth in the normal, but for the direction opposite to the axis,
    around which the frame winds twice. A field that is smooth in space thus bends normals smoothly, which it would not
    with a basis that changes sides at an equator.

    Args:
        normal: (N, 3) unit length, canonical or user frame: their axes are the same.
    """
    normal = np.asarray(normal, dtype=np.float64)
    first, second, axis = reference_frame()
    along = 1.0 + normal @ axis
    across = np.where((along > SINGULAR)[:, None], (axis + normal) / np.maximum(along, SINGULAR)[:, None], 0.0)
    return first - across * (normal @ first)[:, None], second - across * (normal @ second)[:, None]
