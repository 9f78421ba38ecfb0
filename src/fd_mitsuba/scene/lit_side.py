"""Whether the base can be seen at all: which side of its faces Mitsuba shades, what they give back, what light comes.

The winding of a file does not decide that: `flip_normals`, a mirroring `to_world`, stored normals and two-sided BSDFs
all have a say. So the loaded shapes themselves are asked. Outwards is where rays get away from the base.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fd_mitsuba.backend.file_threads import file_threads
from fd_mitsuba.scene.triangle_mesh import TriangleMesh

_POINTS = 1024
_DRAWS = 4
_RAYS = 8
"""A side is the outer one if at least one of these gets away from it and none from the other, or half of them more."""
_LIFT = 1e-3
"""Where rays start above the surface, in units of the base's longest side."""
_FEWEST = 20
"""Points whose outer side is known, below which nothing is said of a shape."""
_DARK_SHARE = 0.02
"""Of the outside; a well-made mesh has two in a thousand where its pieces meet."""
_MOST_GIVEN_BACK = 1.1
_BRIGHTEST = 10.0


@dataclass(frozen=True)
class ShapeShading:
    """How Mitsuba shades one shape of the base, seen from outside.

    Attributes:
        name: of the shape.
        dark: share of its outer surface that gives no light back, as a one-sided BSDF does from behind.
        dark_within: the same where these points are seen from the inner side.
        given_back: light that it gives back from its other points, of a light of 1; the largest channel.
        light: radiance that a white surface would have in the scene's direct light, mean over its outer surface; NaN
            without a light.
    """

    name: str
    dark: float
    dark_within: float
    given_back: float
    light: float


def shaded_shapes(mi: Any, loaded: Any, shapes: list[Any], meshes: tuple[TriangleMesh, ...]) -> list[ShapeShading]:
    """One entry for each shape whose outer side can be told, from `_POINTS` random points on each.

    Args:
        loaded: the scene with its lights.
        shapes: the base's shapes in it.
        meshes: their triangles in the same order, user frame.
    """
    alone = mi.load_dict({"type": "scene", **{f"shape_{i}": s for i, s in enumerate(shapes)}}, optimize=False)
    side = max(float(np.ptp(np.concatenate([mesh.vertices for mesh in meshes]), axis=0).max()), 1e-30)
    samples = [_surface_samples(mesh, np.random.default_rng(number)) for number, mesh in enumerate(meshes)]
    points = np.concatenate([found[0] for found in samples])
    normals = np.concatenate([found[1] for found in samples])
    free = np.stack([_rays_away(mi, alone, points, turn * normals, _LIFT * side) for turn in (1.0, -1.0)])
    better = free[0] >= free[1]
    most, least = np.maximum(*free), np.minimum(*free)
    known = ((least == 0) & (most > 0)) | (most - least >= _RAYS // 2)
    outward = np.where(better[:, None], normals, -normals)
    with file_threads():
        weights, hit = _given_back(mi, alone, points, outward, _LIFT * side)
        dark = weights.max(axis=1) <= 0
        within = dark.copy()
        if (dark & hit & known).any():
            within &= _given_back(mi, alone, points, -outward, _LIFT * side)[0].max(axis=1) <= 0
        light = _white(mi, loaded, points + _LIFT * side * outward, outward)
    owner = np.repeat(np.arange(len(meshes)), [len(found[0]) for found in samples])
    found = []
    for number, mesh in enumerate(meshes):
        here = (owner == number) & known & hit
        if here.sum() >= _FEWEST:
            bright = here & ~dark
            given = float(weights[bright].mean(axis=0).max()) if bright.any() else 0.0
            shares = float(dark[here].mean()), float(within[here].mean())
            found.append(ShapeShading(mesh.name, *shares, given, float(light[here].mean())))
    return found


def shading_warnings(mi: Any, loaded: Any, shapes: list[Any], meshes: tuple[TriangleMesh, ...]) -> list[str]:
    """What would spoil every picture of the base, a sentence for each shape and cause; see `shaded_shapes`."""
    warnings = []
    for shape in shaded_shapes(mi, loaded, shapes, meshes):
        name, cure = f"base {shape.name}", "wrap its BSDF in a twosided"
        wrong_way = shape.dark - shape.dark_within
        if shape.dark_within > 0.98:
            warnings.append(f"{name}: it is all black, because its BSDF gives no light back; raise its colours above 0")
        elif wrong_way > 0.98:
            flip = 'write <boolean name="flip_normals" value="true"/> in the shape'
            warnings.append(f"{name}: it is black from outside, because its normals point inwards; {flip}, or {cure}")
        elif wrong_way > _DARK_SHARE:
            problem = f"{wrong_way:.0%} of its outside is black, because faces or normals there point inwards"
            warnings.append(f"{name}: {problem}; make all of them point outwards, or {cure}")
        if shape.given_back > _MOST_GIVEN_BACK:
            problem = f"it gives back {shape.given_back:.2g} times the light that it gets"
            warnings.append(f"{name}: {problem}; keep the colours of its BSDF between 0 and 1")
        if shape.light == 0:
            warnings.append(f"{name}: no light of the scene reaches it, so that it is black; move or turn the light")
        elif shape.light > _BRIGHTEST:
            problem = f"the light makes white {shape.light:.3g} times as bright as an image can show"
            warnings.append(f"{name}: {problem}; multiply its scale by {0.8 / shape.light:.2g}")
    return warnings


def _given_back(
    mi: Any, alone: Any, points: np.ndarray, side: np.ndarray, lift: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of a light of 1, (N, 3) what the BSDF gives back towards unit vectors `side`, and (N,) where that can be told.

    It cannot where the surface was not found, or is see-through.
    """
    import drjit as dr

    ray = mi.Ray3f(_vector(mi.Point3f, points + lift * side), _vector(mi.Vector3f, -side))
    surface = alone.ray_intersect(ray)
    bsdf, context, valid = surface.bsdf(ray), mi.BSDFContext(), surface.is_valid() & (surface.t < 2 * lift)
    weights, opaque = np.zeros((len(points), 3)), np.zeros(len(points), dtype=bool)
    for one, two, three in np.random.default_rng(7).random((_DRAWS, 3, len(points))).astype(np.float32):
        sample, weight = bsdf.sample(context, surface, mi.Float(one), mi.Point2f(mi.Float(two), mi.Float(three)), valid)
        through = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        found = np.array(dr.select(through, 0, weight)).T
        weights += (found if found.shape[1] == 3 else found[:, :1]) / _DRAWS
        opaque |= ~np.broadcast_to(np.array(through), len(points))
    return weights, np.array(valid) & opaque


def _white(mi: Any, loaded: Any, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(N,) radiance of a white, matt surface there in the direct light; NaN where there is no light."""
    import drjit as dr

    if not loaded.emitters():
        return np.full(len(points), np.nan)
    surface = dr.zeros(mi.SurfaceInteraction3f, len(points))
    surface.p, surface.n = _vector(mi.Point3f, points), _vector(mi.Normal3f, normals)
    light = np.zeros(len(points))
    for one, two in np.random.default_rng(8).random((_DRAWS, 2, len(points))).astype(np.float32):
        towards, radiance = loaded.sample_emitter_direction(surface, mi.Point2f(mi.Float(one), mi.Float(two)), True)
        light += np.array(dr.max(radiance) * dr.maximum(dr.dot(towards.d, surface.n), 0)) / np.pi / _DRAWS
    return light


def _surface_samples(mesh: TriangleMesh, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3), uniform over the area, and the unit normals of their faces."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    if not area.sum() > 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    chosen = random.choice(len(area), size=_POINTS, p=area / area.sum())
    weights = random.dirichlet([1.0, 1.0, 1.0], size=_POINTS)
    return np.einsum("ij,ijk->ik", weights, corners[chosen]), normal[chosen] / area[chosen, None]


def _rays_away(mi: Any, scene: Any, points: np.ndarray, normals: np.ndarray, lift: float) -> np.ndarray:
    """(N,) how many of `_RAYS` rays into the hemisphere around the normals meet nothing."""
    random = np.random.default_rng(5)
    ball = random.normal(size=(_RAYS, len(points), 3))
    ball /= np.linalg.norm(ball, axis=2, keepdims=True)
    direction = ball + 1.001 * normals  # spread as the cosine
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    start = np.broadcast_to(points + lift * normals, direction.shape).reshape(-1, 3)
    ray = mi.Ray3f(_vector(mi.Point3f, start), _vector(mi.Vector3f, direction.reshape(-1, 3)))
    return (~np.array(scene.ray_test(ray))).reshape(_RAYS, -1).sum(axis=0)


def _vector(kind: Any, rows: np.ndarray) -> Any:
    return kind(np.ascontiguousarray(rows.T, dtype=np.float32))
