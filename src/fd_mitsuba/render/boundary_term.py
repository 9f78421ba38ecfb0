"""The part of a picture's derivative that comes from outlines in motion."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from fd_mitsuba.conventions import NormalSpace
from fd_mitsuba.render.cameras import FilmCameras
from fd_mitsuba.render.mesh_tracer import Hit
from fd_mitsuba.render.outline_points import OutlinePoints
from fd_mitsuba.render.surface_point import ShadedMesh, channels, shade_hit

_STEP_ASIDE = 1e-6
"""How far outside the outline the background is looked up, as a share of the picture's width.

Slivers near the outline are often narrower on the film than 1e-5 of its width; a longer step leaps over them and counts
the outline twice (4 % too much on a marching-cubes surface). Below 3e-7 rounding takes over.
"""

_NEARER = 1e-4
"""What lies in front of an outline point by more than this share of its depth hides it."""


def film_beside(points: OutlinePoints, size: int) -> mi.Point2f:
    """Film points just outside the outline, in pictures of `size` pixels a side."""
    return points.film + (_STEP_ASIDE * size) * points.outwards


def add_boundary_term(
    picture: list[mi.Float],
    mesh: ShadedMesh,
    cameras: FilmCameras,
    points: OutlinePoints,
    behind: Hit,
    space: NormalSpace,
) -> None:
    """Attaches the outline's derivative to a picture, whose values stay as they are.

    With I the five channels, q a point of the outline on the film and m its outward unit normal there, a pixel P obeys
        d/dx integral_P I = integral_P dI/dx + integral_{outline in P} (I_inside - I_outside) (m . dq/dx) dl,
    and this is the second integral, estimated by points that each stand for the same length. I_inside is the surface's
    value at the edge itself. I_outside is what one ray beside the edge sees; that ray also tells if the edge is hidden.

    Args:
        picture: five arrays of B size^2 pixels, changed in place.
        points: on the outline of `mesh`, in pictures of the same size.
        behind: what is seen at `film_beside` of them.
    """
    camera = cameras.at(points.view)
    beside = camera.ray(film_beside(points, cameras.size))
    visible = behind.depth > points.depth * (1 - _NEARER)
    film, view, along, (first, second) = points.film, points.view, points.along, points.vertices
    with dr.suspend_grad():
        everywhere = mi.Bool(True)
        normal, part = mesh.blend([first, second], [1 - along, along], everywhere)
        inside = channels(normal, part, everywhere, camera, space)
        outside = shade_hit(mesh, beside, behind, camera, space)
        jump = [dr.select(visible, (a - b) * points.length, 0) for a, b in zip(inside, outside, strict=True)]
        dr.eval(jump)

    point = (1 - along) * mesh.positions(first, everywhere) + along * mesh.positions(second, everywhere)
    motion = dr.dot(points.outwards, camera.film(point))
    if not dr.grad_enabled(motion):  # only part weights are wanted, and those do not move outlines
        return
    size = cameras.size
    column, row = (mi.UInt32(dr.clip(mi.Int32(value), 0, size - 1)) for value in (film.x, film.y))
    pixel = (view * size + row) * size + column
    for channel, value in enumerate(jump):
        # Zero, but with the derivative of `value * motion`.
        dr.scatter_reduce(dr.ReduceOp.Add, picture[channel], dr.replace_grad(mi.Float(0), value * motion), pixel)
