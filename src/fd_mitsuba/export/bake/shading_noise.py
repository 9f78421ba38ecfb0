"""How noisy a surface's shading is, and how rough a material must be so that the noise is not seen in it."""

from __future__ import annotations

import math

import numpy as np

from fd_mitsuba.scene.vertex_normals import angles_between, vertex_normals

_SAMPLES = 40_000
_SMOOTHED_OVER = 0.02


def widened_roughness(roughness: np.ndarray, noise_deg: float) -> np.ndarray:
    """The roughness of a surface whose normals' noise is taken for a part of its microfacets; of the input's shape.

    alpha = roughness^2 becomes sqrt(alpha^2 + 2 s^2), with s the slopes' standard deviation along one axis: the same
    highlight as that of the noise on average, without its streaks. A near-mirror widens, a dull surface hardly changes.
    For microfacets with Beckmann's distribution this is exact; the idea is Toksvig's, Mipmapping Normal Maps (2005).

    Args:
        noise_deg: see `surface_noise`: the mean angle, so s sqrt(pi / 2) for small ones.
    """
    slope = math.tan(math.radians(min(noise_deg, 60.0))) / math.sqrt(math.pi / 2)
    return np.sqrt(np.sqrt(roughness**4 + 2 * slope**2)).clip(max=1.0).astype(roughness.dtype)


def surface_noise(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None = None,
    smoothed_over: float = _SMOOTHED_OVER,
    seed: int = 0,
) -> float:
    """Mean angle in degrees between the shading normals and the same ones smoothed; 0 on a plane or a large ball.

    At points spread evenly over the surface, so that meshes of any density compare, the shading normal is compared
    with those within a distance: with the linear function of space that fits them best. The other side of a thin wall
    does not count: normals more than 90 degrees apart are left out. Even curvature is fitted, edges and noise are not.

    Args:
        normals: (V, 3) of the vertices; None: smooth ones of the faces around them.
        smoothed_over: the radius of the fit, as a share of the longest side of the bounds.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    normals = vertex_normals(vertices, faces) if normals is None else np.asarray(normals, dtype=np.float64)
    points, shading = _spread(vertices, faces, normals, seed)
    radius = smoothed_over * float(np.ptp(vertices, axis=0).max())
    from scipy.spatial import KDTree  # imported late: whoever only names formats needs none

    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[np.einsum("ij,ij->i", shading[pairs[:, 0]], shading[pairs[:, 1]]) > 0]
    return float(np.degrees(angles_between(shading, _fitted(points, shading, pairs, radius))).mean())


def _fitted(points: np.ndarray, values: np.ndarray, pairs: np.ndarray, radius: float) -> np.ndarray:
    """Per point the value there of the linear function that fits its own and its neighbours' values best, (N, 3)."""
    count = len(points)
    squares, products = np.zeros((count, 4, 4)), np.zeros((count, 4, 3))
    squares[:, 0, 0], products[:, 0] = 1, values
    for one, other in (pairs.T, pairs[:, ::-1].T):
        rows = np.concatenate([np.ones((len(one), 1)), (points[other] - points[one]) / radius], axis=1)
        for i in range(4):
            for j in range(4):
                squares[:, i, j] += np.bincount(one, rows[:, i] * rows[:, j], count)
            for axis in range(3):
                products[:, i, axis] += np.bincount(one, rows[:, i] * values[other, axis], count)
    # Neighbours lie in a plane, nearly: across it there is nothing to fit.
    squares[:, [1, 2, 3], [1, 2, 3]] += 0.02 * squares[:, 0, 0, None]
    return np.linalg.solve(squares, products)[:, 0]


def _spread(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) spread over the faces by area, and the interpolated unit normals (N, 3) there."""
    rng = np.random.default_rng(seed)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    ends = np.cumsum(area)
    chosen = np.searchsorted(ends, (np.arange(_SAMPLES) + rng.random(_SAMPLES)) / _SAMPLES * ends[-1])
    chosen = np.minimum(chosen, len(faces) - 1)
    first, second = np.sqrt(rng.random(_SAMPLES)), rng.random(_SAMPLES)
    weights = np.stack([1 - first, first * (1 - second), first * second], axis=1)[..., None]
    shading = (weights * normals[faces[chosen]]).sum(axis=1)
    length = np.linalg.norm(shading, axis=1, keepdims=True)
    return (weights * corners[chosen]).sum(axis=1), shading / np.maximum(length, 1e-12)
