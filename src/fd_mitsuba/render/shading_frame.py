"""The part's shading frame: the mesh's smooth normal, bent by the field's perturbation, differentiably."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from fd_mitsuba.fields.tangent_frame import SINGULAR, reference_frame

LEAST_COSINE = 0.02
"""Between a bent normal and the direction to the viewer: a normal that would face away is turned back to this."""


def tangent_frame(normal: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Tangent and bitangent of unit normals: `fields.tangent_frame.tangent_frame` in Dr.Jit."""
    first, second, axis = (mi.Vector3f(*vector.tolist()) for vector in reference_frame())
    along = 1 + dr.dot(axis, normal)
    across = dr.select(along > SINGULAR, (axis + normal) / dr.maximum(along, SINGULAR), 0)
    return first - across * dr.dot(first, normal), second - across * dr.dot(second, normal)


def bent_frame(normal: mi.Vector3f, perturbation: mi.Vector3f, towards_viewer: mi.Vector3f) -> mi.Frame3f:
    """The frame to shade in; differentiable in `perturbation`.

    A perturbation may turn a normal away from the viewer, who would then see black: stock BSDFs reflect nothing below
    their horizon. Such a normal n is replaced by n + (c - n . v) v, v the direction to the viewer and c `LEAST_COSINE`,
    which is continuous where the replacement begins and keeps a derivative beyond. Smooth normals of a coarse mesh,
    which also turn away close to the outline, profit likewise.

    Args:
        normal: the mesh's smooth normal, unit length.
        perturbation: tangent space, of any length but 0; (0, 0, 1) changes nothing.
        towards_viewer: unit length, on the outer side of the surface.
    """
    tangent, bitangent = tangent_frame(normal)
    length = dr.rsqrt(dr.maximum(dr.squared_norm(perturbation), 1e-12))
    bent = (perturbation.x * tangent + perturbation.y * bitangent + perturbation.z * normal) * length
    missing = LEAST_COSINE - dr.dot(bent, towards_viewer)
    bent = dr.normalize(bent + dr.select(missing > 0, missing, 0) * towards_viewer)
    # Isotropic BSDFs do not see how the other two axes lie; these lie as without the perturbation, made orthogonal.
    side = tangent - bent * dr.dot(bent, tangent)
    usable = dr.squared_norm(side) > 1e-6
    side = dr.normalize(dr.select(usable, side, bitangent - bent * dr.dot(bent, bitangent)))
    return mi.Frame3f(side, dr.cross(bent, side), bent)
