"""Whether a mesh has an inside, and cameras are outside of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np


def is_closed(triangles: mi.UInt32) -> bool:
    """Whether faces (flat) run along every edge as often in one direction as in the other.

    Exactly then is the sum of r_a q_b - r_b q_a over all half-edges a -> b zero whatever the vertices' r and q are:
    the area of a closed surface's projection. They are pseudo-random integers here, the sum is modulo 2^64.
    """
    if not len(triangles):
        return True
    total = mi.UInt64(0)
    corner = [
        _mixed(index) for index in dr.gather(mi.Vector3u, triangles, dr.arange(mi.UInt32, dr.width(triangles) // 3))
    ]
    for (r_a, q_a), (r_b, q_b) in zip(corner, corner[1:] + corner[:1], strict=True):
        total += r_a * q_b - r_b * q_a
    return dr.sum(total)[0] == 0


def _mixed(index: mi.UInt32) -> tuple[mi.UInt64, mi.UInt64]:
    """Two 64-bit numbers from one, by the finaliser of SplitMix64 (Steele et al. 2014) and one round more."""
    x = (mi.UInt64(index) + 1) * 0x9E3779B97F4A7C15
    x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9
    x = (x ^ (x >> 27)) * 0x94D049BB133111EB
    x ^= x >> 31
    y = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9
    return x, y ^ (y >> 27)


def is_outside(points: np.ndarray, vertices: np.ndarray) -> bool:
    """Whether all of the points (N, 3) lie beyond the box about the vertices (V, 3), of which there is one at least."""
    return bool(((points < vertices.min(axis=0)) | (points > vertices.max(axis=0))).any(axis=1).all())
