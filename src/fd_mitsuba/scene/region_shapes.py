"""The entries of a focal region's `shape`: closed meshes of unit size, which its `to_world` puts in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.registry import NoSettings, Registry
from fd_mitsuba.config.section import Section
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.tessellate import Arrays, unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh, topology

ELLIPSOID = "ellipsoid"
"""The default shape; its distance is exact and not that of its triangles."""

REGION_SHAPES: Registry[Callable[[Any], Arrays]] = Registry("region_shapes", "region shape")
"""Called with their settings; give vertices (V, 3) and outward faces (F, 3) of a closed mesh around the origin."""


@REGION_SHAPES.register(ELLIPSOID)
def ellipsoid(settings: NoSettings) -> Arrays:
    """The sphere of radius 1, of which `to_world` makes an ellipsoid; its triangles are for pictures."""
    return unit_sphere(4)


@REGION_SHAPES.register("box")
def box(settings: NoSettings) -> Arrays:
    """The cube from -1 to 1, as Mitsuba's `cube`."""
    corners = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    sides = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
    first = 4 * np.arange(6)[:, None]  # each side has corners of its own, so that its edges are sharp in a picture
    return corners[sides.ravel()], np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])


class CylinderSettings(Section):
    """Of `cylinder`."""

    top: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    """Radius at z = 1, where it is 1 at z = -1: less makes a truncated cone."""


@REGION_SHAPES.register("cylinder", CylinderSettings)
def cylinder(settings: CylinderSettings) -> Arrays:
    """A closed cylinder of radius 1 around the z axis, from z = -1 to z = 1, with 96 sides."""
    count = 96
    angle = np.arange(count) * (2 * np.pi / count)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    lower, upper = rim - [0, 0, 1], rim * settings.top + [0, 0, 1]
    a, b = np.arange(count), np.roll(np.arange(count), -1)
    low, high = np.full(count, 4 * count), np.full(count, 4 * count + 1)
    side = [(a, b, b + count), (a, b + count, a + count)]
    a, b = a + 2 * count, b + 2 * count  # the ends have rims of their own, so that their edges are sharp in a picture
    ends = [(low, b, a), (high, a + count, b + count)]
    vertices = np.concatenate([lower, upper, lower, upper, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    return vertices, np.concatenate([np.stack(face, axis=1) for face in [*side, *ends]])


def shape_arrays(choice: Choice) -> Arrays:
    """Vertices and outward faces of a shape, checked.

    Raises:
        UserError: an unknown shape, a wrong setting, or an entry that gives no closed mesh.
    """
    given = REGION_SHAPES.make(choice, "shape")
    try:
        mesh = TriangleMesh(choice.kind, *given)
    except (TypeError, ValueError) as error:
        raise UserError(f"shape {choice.kind!r}: gives no vertices and faces ({error}); mend its module") from None
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces) or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise UserError(f"shape {choice.kind!r}: gives faces without vertices, or no faces; mend its module")
    if not topology(vertices, faces).closed or not mesh.volume() > 0:
        raise UserError(f"shape {choice.kind!r}: gives no closed mesh with faces outward; mend its module")
    return vertices, faces
