"""The part's solid as it is handed over: from the functions themselves, finer than the training's grid, evenly meshed.

The training marches a grid whose cells are as large as what a picture of 32 pixels can show. Its field is smooth
beyond that; what looked torn was the marching. Here the same solid is

1. sampled on a lattice two to four times finer, around its surface only, and marched (`fine_lattice`);
2. remeshed into triangles of one size, every vertex on the function's zero set, and some of them along the rim of the
   joint (`meshing`, `remesh`, `projection`, `rim`);
3. given smooth normals that keep its edges (`shading`).

The offsets of the grid's vertices are left out: they are noise a tenth of a cell high, and make the dents.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from fd_mitsuba.export.final_surface.contact import contact_of
from fd_mitsuba.export.final_surface.fillet import fillet_reach, foot_width, shown_part
from fd_mitsuba.export.final_surface.fine_lattice import FineLattice, refined
from fd_mitsuba.export.final_surface.learned import learned_spline
from fd_mitsuba.export.final_surface.meshing import edge_for, evenly_meshed
from fd_mitsuba.export.final_surface.part_function import PartFunction
from fd_mitsuba.export.final_surface.rim import rim_normals
from fd_mitsuba.export.final_surface.shading import smooth_normals
from fd_mitsuba.export.solid.decimation import decimated
from fd_mitsuba.export.solid.part_pieces import fill_pockets, keep_large
from fd_mitsuba.export.solid.part_solid import LatticePart, lattice_part, part_solid, part_surface
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.extraction.grown_part import GrownPart
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.vertex_normals import vertex_normals

_FINER = (2, 4)
"""How many times finer than the training's the lattice is: as its edges are to be, within these."""
_BESIDE_CELLS = 0.5
"""So far beyond the rim the flank that dives under the base is shaded as if the fillet went on, in cells."""
_FILM_CELLS = 0.06
"""Where the fillet is lower over the base, in cells of the training, the solid dives under the base."""


@dataclass(frozen=True)
class FinalPart:
    """A part's final surface.

    Attributes:
        solid: canonical frame.
        normals: (V, 3) float64 unit, for shading.
        distance: (V,) how far the vertices are from the zero set by the last projection, canonical units.
    """

    solid: Solid
    normals: np.ndarray
    distance: np.ndarray

    def decimated(self, faces: int) -> FinalPart:
        """The part with at most `faces` faces, or as few as stay a solid; its normals are those of the full surface."""
        solid = decimated(self.solid, faces)
        if solid is self.solid:
            return self
        full = MeshDistance(self.solid.vertices, self.solid.faces)
        face, weights = full.nearest(solid.vertices)
        normals = np.einsum("ij,ijk->ik", weights, self.normals[self.solid.faces[face]])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return FinalPart(solid, normals / np.maximum(length, 1e-12), full.unsigned(solid.vertices))


_NOTHING = FinalPart(Solid(np.zeros((0, 3)), np.zeros((0, 3))), np.zeros((0, 3)), np.zeros(0))


def final_parts(grown: GrownPart, faces: int, say: Callable[[str], None] = lambda line: None) -> dict[str, FinalPart]:
    """The final surface of every named part; see `final_part`."""
    return {name: final_part(grown, name, faces, say) for name in grown.parts}


def final_part(
    grown: GrownPart, name: str | None, faces: int, say: Callable[[str], None] = lambda line: None
) -> FinalPart:
    """The final surface of one named part (None: of all together) with at most `faces` triangles, or few more.

    Where no solid comes out of it, the training's own surface is taken, and a line says so.
    """
    coarse = lattice_part(grown, name)
    spacing = coarse.grid.spacing
    edge = edge_for(*part_surface(coarse), faces, spacing)
    factor = int(np.clip(round(spacing / edge), *_FINER))
    function = part_function(grown, coarse, factor)
    made = refined(coarse.grid, _lattice(coarse, _least(coarse)), function.values, factor)
    if made is None:
        return _NOTHING
    inside, islands = _meant(coarse, made)
    vertices, triangles = made.surface(inside)
    if not len(triangles):
        return _NOTHING

    try:
        vertices, triangles, distance = evenly_meshed(function, vertices, triangles, faces, 0.5 * made.spacing)
        solid = Solid(vertices, triangles, islands, coarse.bridged)
    except ValueError:
        solid, distance = _NOTHING.solid, _NOTHING.distance
    if not solid.manifold:
        say(f"part {name or 'part'}: its fine surface is no solid; the training's own is written instead")
        plain = part_solid(grown, name)
        return FinalPart(plain, vertex_normals(plain.vertices, plain.faces), np.zeros(len(plain.vertices)))
    normals = smooth_normals(vertices, triangles, spacing, rim_normals(function.rim, vertices, _BESIDE_CELLS * spacing))
    return FinalPart(solid, normals, distance)


def part_function(grown: GrownPart, coarse: LatticePart, factor: int) -> PartFunction:
    """The function of space whose zero set is the part's solid, bridges included.

    Args:
        factor: how many times finer than the training's a lattice for the part's own surface is.
    """
    extractor, grid = grown.extractor, coarse.grid
    base = None if coarse.cuts else MeshDistance(grown.base.vertices, grown.base.faces)

    reach = foot_width(extractor.union_k, grid.spacing) + fillet_reach(extractor.union_k, _FILM_CELLS * grid.spacing)
    function = PartFunction(
        learned_spline(grown), list(grown.parts.values()), coarse.number, grid, base, extractor.union_k,
        extractor.union_only_outside, reach, coarse.sink, _lattice(coarse, coarse.sdf_base), coarse.bridges,
    )  # fmt: skip
    if base is None:
        return function
    if coarse.bridges:
        start, _ = extractor.lattice_values(grown.field)
        before = _surface_of(coarse, factor, start, function.part_values)
        function = replace(function, surface=None if before is None else MeshDistance(*before))
    shown = shown_part(coarse.sdf_base, coarse.sdf_part, extractor.union_k)
    own = _surface_of(coarse, factor, shown, function.shown_values)
    if own is None:
        return function
    lattices = _lattice(coarse, coarse.sdf_base), _lattice(coarse, shown)
    contact = contact_of(grid, *lattices, base, own, lambda points: function.shown_values(points) > 0, reach)
    return replace(function, contact=contact)


def _surface_of(
    coarse: LatticePart, factor: int, values: torch.Tensor, function: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    made = refined(coarse.grid, _lattice(coarse, values), function, factor)
    if made is None:
        return None
    vertices, faces = made.surface(made.values > 0)
    return (vertices, faces) if len(faces) else None


def _meant(coarse: LatticePart, made: FineLattice) -> tuple[np.ndarray, int]:
    """Where the solid is on the fine lattice, without stray islands and with its pockets filled; how many went."""
    part, base = (made.between(_lattice(coarse, x)) for x in (coarse.sdf_part, coarse.sdf_base))
    owner = made.nearest(_lattice(coarse, coarse.owner))
    inside = made.values > 0
    mine = coarse.number if coarse.lead is not None else None
    inside, removed = keep_large(inside, (part > 0) * (1.0 if mine is None else owner == mine), owner)
    return fill_pockets(inside, base < coarse.sink), sum(removed) if mine is None else removed[mine]


def _least(coarse: LatticePart) -> torch.Tensor:
    fields = coarse.fields if coarse.lead is None else [*coarse.fields, coarse.lead]
    return torch.stack(fields).amin(dim=0)


def _lattice(coarse: LatticePart, values: torch.Tensor) -> np.ndarray:
    return values.view((coarse.grid.side,) * 3).numpy()
