"""Which face a film point sees first, found face by face: for many small faces that change at every step.

A ray tracer must sort the faces before it can look for one, which for faces smaller than the distance between samples
costs more than looking. Here every face is projected instead, visits the film points inside its bounding box, and
leaves its depth and number where it is the nearest so far. Film points are sorted into cells first, row by row, so that
those in a box are a few contiguous runs.

Nothing here is differentiable. The result does not depend on the order of the faces, nor on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from fd_mitsuba.render.cameras import FilmCameras

_NOTHING = 2**64 - 1
"""No face. What a point remembers is one number, the bits of a depth above those of the face's number: the smaller is
the nearer, since positive floats are in the order of their bits, and at equal depths the face that comes first."""
_SLACK = 1e-3
"""By how many pixels a face's box is widened: rounding, and points that step across the picture's border."""
_NEAREST_DEPTH = 1e-3
"""Faces that come nearer to a camera's plane than this have no box; they count as large."""


@dataclass(frozen=True)
class FilmPoints:
    """P film points of several views, sorted into cells of the film, row after row; evaluated."""

    x: mi.Float
    """(P) the ray's direction to the right, for one unit of depth; in sorted order, as `y`."""
    y: mi.Float
    place: mi.UInt32
    """(P) where each point, in the order in which they were given, is in the sorted order."""
    starts: mi.UInt32
    """(views rows columns + 1) where each cell's points begin."""
    columns: int
    """Cells across the film; a multiple of its size."""
    rows: int


@dataclass(frozen=True)
class NearestFaces:
    """What the faces left at every point, in the points' given order; evaluated."""

    seen: mi.Bool
    face: mi.UInt32
    """Counted from the first face of those drawn; 0 where there is none."""
    depth: mi.Float
    """Infinite where there is none."""
    large: mi.UInt32
    """The faces that were left out, because their box in some view is too large, or has no end."""


def sort_points(cameras: FilmCameras, film: mi.Point2f, view: mi.UInt32) -> FilmPoints:
    """Sorts points of the film; those beyond its border count as in its outermost cells.

    Cells are about six times as many as points. A face visits every row that its box touches, but the points of a row's
    cells lie in one run, so that columns may be narrower.

    Args:
        cameras: the views.
        film: (P) pixels.
        view: (P).
    """
    per_pixel = dr.width(view) / (cameras.count * cameras.size**2)
    rows_per_pixel = max(1, round(1.75 * math.sqrt(per_pixel)))
    columns_per_pixel = 2 * rows_per_pixel
    columns, rows = cameras.size * columns_per_pixel, cameras.size * rows_per_pixel
    column = mi.UInt32(dr.clip(mi.Int32(film.x * columns_per_pixel), 0, columns - 1))
    row = mi.UInt32(dr.clip(mi.Int32(film.y * rows_per_pixel), 0, rows - 1))
    cell = (view * rows + row) * columns + column
    counts = dr.zeros(mi.UInt32, cameras.count * rows * columns + 1)
    rank = dr.scatter_inc(counts, cell)
    dr.eval(rank, counts)
    starts = dr.prefix_sum(counts)
    place = dr.gather(mi.UInt32, starts, cell) + rank
    direction = cameras.at(view).slope(film)
    x, y = (dr.empty(mi.Float, dr.width(view)) for _ in range(2))
    dr.scatter(x, direction.x, place, mode=dr.ReduceMode.Permute)
    dr.scatter(y, direction.y, place, mode=dr.ReduceMode.Permute)
    dr.eval(x, y, place, starts)
    return FilmPoints(x, y, place, starts, columns, rows)


def nearest_faces(
    points: FilmPoints, cameras: FilmCameras, vertices: mi.Float, faces: mi.UInt32, first: mi.UInt32, count: int,
    largest: int = 64, front_only: bool = False,
) -> NearestFaces:  # fmt: skip
    """Draws `count` faces from number `first` on.

    Args:
        points: where.
        cameras: those for which the points were sorted.
        vertices: (3 V) flat, detached.
        faces: (3 F) flat.
        first: one number, opaque, so that another one compiles nothing.
        count: at least 1.
        largest: faces whose box touches more rows of cells than this, or more columns than four times this, are left
            out of the view and listed as large.
        front_only: leaves out faces that are turned away from the eye, which saves a third of the time.
    """
    nearest = dr.full(mi.UInt64, _NOTHING, dr.width(points.x))
    with dr.suspend_grad():
        number = dr.arange(mi.UInt32, count)
        triangle = dr.gather(mi.Vector3u, faces, number + first)
        corners = [dr.gather(mi.Point3f, vertices, triangle[k]) for k in range(3)]
        views = dr.opaque(mi.UInt32, cameras.count)

        def draw(view: mi.UInt32, large: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
            return view + 1, large | _draw(points, cameras, view, number, corners, nearest, largest, front_only)

        start = (mi.UInt32(0), mi.Bool(False))
        _, large = dr.while_loop(start, lambda view, large: view < views, draw, mode="symbolic")
        dr.eval(large, nearest)
        key = dr.gather(mi.UInt64, nearest, points.place)
        seen = key != _NOTHING
        face = dr.select(seen, mi.UInt32(key & 0xFFFFFFFF), 0)
        depth = dr.select(seen, dr.reinterpret_array(mi.Float, mi.UInt32(key >> 32)), dr.inf)
        dr.eval(seen, face, depth)
        return NearestFaces(seen, face, depth, dr.compress(large))


def edge_planes(a: mi.Vector3f, b: mi.Vector3f, c: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]:
    """The planes through the eye and a triangle's edges, of corners as the eye sees them.

    A direction's products with them are in proportion to the weights of a, b and c where it meets the triangle. A cross
    product with the difference of two corners keeps the digits that one of two corners would lose.
    """
    return dr.cross(b, c - b), dr.cross(c, a - c), dr.cross(a, b - a)


def _draw(
    points: FilmPoints, cameras: FilmCameras, view: mi.UInt32, number: mi.UInt32, corners: list[mi.Point3f],
    nearest: mi.UInt64, largest: int, front_only: bool,
) -> mi.Bool:  # fmt: skip
    """Leaves faces in `nearest` for one view; tells which are too large for it."""
    camera = cameras.at(view)
    a, b, c = (camera.from_eye(corner) for corner in corners)
    low_depth, high_depth = _range([a.z, b.z, c.z])
    behind, in_front = high_depth <= 0, low_depth > _NEAREST_DEPTH
    scale, centre = 0.5 * cameras.size / camera.half_width, 0.5 * cameras.size
    per_depth = [scale / dr.maximum(corner.z, _NEAREST_DEPTH) for corner in (a, b, c)]
    left, right = _range([corner.x * factor for corner, factor in zip((a, b, c), per_depth, strict=True)])
    low, high = _range([corner.y * factor for corner, factor in zip((a, b, c), per_depth, strict=True)])
    first_column, last_column = _cells(centre + left, centre + right, points.columns, cameras.size)
    first_row, last_row = _cells(centre - high, centre - low, points.rows, cameras.size)
    meets = in_front & (first_column <= last_column) & (first_row <= last_row)
    wide = (last_row - first_row >= largest) | (last_column - first_column >= 4 * largest)
    large = ~behind & (~in_front | (meets & wide))
    planes = edge_planes(a, b, c)
    height = dr.dot(a, dr.cross(b - a, c - a))
    drawn = meets & ~wide & (height > 0) if front_only else meets & ~wide
    last_row = dr.select(drawn, last_row, -1)
    begin = view * points.rows

    def draw_row(row: mi.Int32) -> tuple[mi.Int32]:
        cell = (begin + mi.UInt32(row)) * points.columns
        place = dr.gather(mi.UInt32, points.starts, cell + mi.UInt32(first_column))
        end = dr.gather(mi.UInt32, points.starts, cell + mi.UInt32(last_column) + 1)
        dr.while_loop((place, end), lambda place, end: place < end, draw_point, mode="symbolic")
        return (row + 1,)

    def draw_point(place: mi.UInt32, end: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        x, y = dr.gather(mi.Float, points.x, place), dr.gather(mi.Float, points.y, place)
        weights = [dr.fma(x, plane.x, dr.fma(y, plane.y, plane.z)) for plane in planes]
        lowest, highest = _range(weights)
        total = weights[0] + weights[1] + weights[2]
        meets = ((lowest >= 0) | (highest <= 0)) & (total != 0)
        depth = dr.clip(height / total, low_depth, high_depth)  # rounding takes it out of faces seen from their edge
        key = (mi.UInt64(dr.reinterpret_array(mi.UInt32, depth)) << 32) | mi.UInt64(number)
        dr.scatter_reduce(dr.ReduceOp.Min, nearest, key, place, meets, mode=dr.ReduceMode.Local)
        return place + 1, end

    dr.while_loop((first_row,), lambda row: row <= last_row, draw_row, mode="symbolic")
    return large


def _range(values: list[mi.Float]) -> tuple[mi.Float, mi.Float]:
    """The least and the largest of three numbers."""
    a, b, c = values
    return dr.minimum(dr.minimum(a, b), c), dr.maximum(dr.maximum(a, b), c)


def _cells(low: mi.Float, high: mi.Float, cells: int, size: int) -> tuple[mi.Int32, mi.Int32]:
    """First and last cell of a range of pixels; the last lies before the first where they are beyond the film."""
    per_pixel = cells // size
    first = mi.Int32(dr.clip((low - _SLACK) * per_pixel, 0, cells - 1))
    last = mi.Int32(dr.clip((high + _SLACK) * per_pixel, 0, cells - 1))
    beyond = (high < -_SLACK) | (low > size + _SLACK)
    return first, dr.select(beyond, -1, last)
