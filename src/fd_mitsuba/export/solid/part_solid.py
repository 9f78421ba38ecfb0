r"""The part as a solid of its own: what the union shows of it, fillet included, sunk a little into the base.

The solid is where all of these are positive, each of them a value per vertex of the grid:

    joined = max(sdf_base - max(away - reach, 0), sdf_part) + fillet
    sunk   = sink - sdf_base
    label  = half the lead of the named part's regions over those of the others   (only with several parts)

With `fillet`, what `soft_union` adds to the larger of its two, `joined` is base and part together, except that the
base counts as lower from where the fillet no more raises it visibly (`away` is the distance to the part): there the
solid's surface dives under the base's, to end in a rim instead of a film. `sunk` cuts out the base below `sink`.
Where the solid's surface is visible it is that of the union, vertex for vertex but for the last cell before the rim.

Across the place where a part stands on the base:

                  |          |
                  |   part   |
                 /            \                <- fillet
    ~~~~~~~~~,__/              \__,~~~~~~~~~   <- the base's surface; what is above it is seen, from rim to rim
              \ . . . . . . . . /              <- at the rim the fillet would be a film: there the solid dives
               \_______________/               <- `sink` below the base's surface

A part that is cut out is plainly where `sdf_part` is positive, inside the base and out of it. The fillet along the
edge of its cut is left out: it ends on the base in a film that the grid makes ragged, and nothing would hide it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.errors import UserError
from fd_mitsuba.export.solid.part_pieces import Bridge, bridge_gaps, distance_to, fill_pockets, keep_large, part_volume
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.extraction.grown_part import GrownPart
from fd_mitsuba.extraction.marching_tets import crossing_faces, crossing_fraction, edge_ends
from fd_mitsuba.extraction.subtraction import SubtractionExtractor
from fd_mitsuba.extraction.tet_grid import TetGrid
from fd_mitsuba.fields.union import soft_union
from fd_mitsuba.scene.focal_region import union_sdf

SINK_CELLS = 1.75
"""How deep the solid reaches into the base, in cells: more than a tetrahedron's longest edge, sqrt(3), so that no
edge leads from below the solid to above the base past it."""

_FILLET_CELLS = 0.12
"""The fillet raises the base ever less, the further from the part; below this, in cells, it is left out: it would be
lost in how far the extracted surface of a curved base is from the base itself, and end in a ragged rim."""


@dataclass(frozen=True)
class LatticePart:
    """What the training's grid knows of a part's solid: all of these are values per vertex of the grid.

    Attributes:
        grid: the grid.
        number: of the named part; None: all together.
        positions: (count, 3) the vertices with their offsets.
        fields: the solid is where all of them, (count,), are positive.
        sdf_base: (count,) base sdf.
        sdf_part: (count,) part sdf, bridges included.
        owner: (count,) number of the named part that a vertex belongs to.
        lead: (count,) half the lead of the part's regions over those of the others; None: nothing to cut off.
        bridges: where the part swells to reach the base.
        reach, sink: see `fillet_reach` and `SINK_CELLS`, canonical units.
        cuts: whether the part is cut out of the base.
    """

    grid: TetGrid
    number: int | None
    positions: Tensor
    fields: list[Tensor]
    sdf_base: Tensor
    sdf_part: Tensor
    owner: Tensor
    lead: Tensor | None
    bridges: list[Bridge]
    reach: float
    sink: float
    cuts: bool

    @property
    def bridged(self) -> float:
        """How far the part had to swell to reach the base, canonical units; 0: it reached by itself."""
        return max((bridge.swelling for bridge in self.bridges), default=0.0)


def lattice_part(grown: GrownPart, name: str | None) -> LatticePart:
    """What the grid knows of one named part (None: of all together), without gradients.

    Raises:
        UserError: no part of that name.
    """
    if name is not None and name not in grown.parts:
        raise UserError(f"no part {name!r} in this scene; it has {', '.join(grown.parts)}")
    extractor, grid = grown.extractor, grown.grid
    sdf_part, positions = extractor.lattice_values(grown.field)
    sdf_base, sink = extractor.sdf_base, SINK_CELLS * grid.spacing
    # Moves inside the base (outside of it, if the part is cut out) are noise: no loss ever saw them.
    positions = torch.where((sdf_base > 0)[:, None], grid.vertices, positions)
    reach = fillet_reach(extractor.union_k, grid.spacing)
    cuts = isinstance(extractor, SubtractionExtractor)

    def limits(part: Tensor) -> list[Tensor]:
        if cuts:
            return [part]
        fillet = soft_union(sdf_base, part, extractor.union_k, extractor.union_only_outside)
        fillet = fillet - torch.maximum(sdf_base, part)
        # Outside the part its sdf is what the losses left there, at times far above the true distance; that to the
        # vertices inside the part bounds it, coarsely: the surface may lie a tetrahedron's edge before them.
        away = torch.maximum(-part, distance_to(grid, part > 0) - math.sqrt(3) * grid.spacing)
        lowered = sdf_base - (away - reach).clamp(min=0)
        return [torch.maximum(lowered, part) + fillet, sink - sdf_base]

    owner, leads = _ownership(grown)
    bridges: list[Bridge] = []
    if not cuts:  # a cavity in the base needs no way out
        sdf_part, bridges = bridge_gaps(grid, sdf_base, sdf_part, owner, lambda part: _inside(limits(part)))
    number = None if name is None else list(grown.parts).index(name)
    lead = leads[number] if number is not None and len(grown.parts) > 1 else None
    return LatticePart(
        grid, number, positions, limits(sdf_part), sdf_base, sdf_part, owner, lead, bridges, reach, sink, cuts
    )


def part_solid(grown: GrownPart, name: str | None) -> Solid:
    """The closed solid of one named part (None: of all together) in the canonical frame, as the training's grid has it.

    It has no faces where the part is empty. Pieces too small to be meant are left out (see `keep_large`), closed
    pockets filled, and gaps between part and base bridged where they are narrow (see `bridge_gaps`). No gradients.

    Raises:
        UserError: no part of that name.
    """
    part = lattice_part(grown, name)
    inside, islands = _meant(part)
    vertices, faces = _surface(part.grid, part.positions, inside, _with_lead(part))
    return Solid(vertices.numpy(), faces.numpy(), islands, part.bridged)


def part_surface(part: LatticePart) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of what `part_solid` makes of it."""
    vertices, faces = _surface(part.grid, part.positions, _meant(part)[0], _with_lead(part))
    return vertices.numpy(), faces.numpy()


def _with_lead(part: LatticePart) -> list[Tensor]:
    return part.fields if part.lead is None else [*part.fields, part.lead]


def _meant(part: LatticePart) -> tuple[Tensor, int]:
    """Where the solid is, (count,) bool, without stray islands and with its pockets filled; how many went."""
    grid, shape = part.grid, (part.grid.side,) * 3
    inside = _inside(part.fields).view(shape).numpy()
    inside, removed = keep_large(inside, part_volume(grid, part.sdf_part), part.owner.view(shape).numpy())
    filled = torch.from_numpy(fill_pockets(inside, (part.sdf_base < part.sink).view(shape).numpy())).view(-1)
    if part.lead is not None:
        filled = filled & (part.lead > 0)
    return filled, sum(removed) if part.number is None else removed[part.number]


def fillet_reach(k: float, spacing: float) -> float:
    """How far from the part, along the base, the fillet of width `k` is worth showing: 0.073 of 0.15 with 64 cells.

    On the base's surface it raises the base by 0.1 (k - distance)^2 / k.
    """
    return max(k - math.sqrt(10 * k * _FILLET_CELLS * spacing), 0.0)


def _inside(fields: list[Tensor]) -> Tensor:
    return reduce(torch.logical_and, [field > 0 for field in fields])


def _ownership(grown: GrownPart) -> tuple[Tensor, list[Tensor]]:
    """The number of the part that each vertex of the grid belongs to, (count,), and each part's lead, (count,)."""
    parts = list(grown.parts.values())
    if len(parts) == 1:
        return torch.zeros(grown.grid.count, dtype=torch.int64), [torch.ones(grown.grid.count)]
    points = grown.grid.vertices.numpy()
    depths = torch.stack([torch.from_numpy(union_sdf(regions, points)).float() for regions in parts])
    leads = []
    for number in range(len(parts)):
        others = torch.cat([depths[:number], depths[number + 1 :]]).amax(dim=0)
        leads.append((depths[number] - others) / 2)
    return depths.argmax(dim=0), leads


def _surface(grid: TetGrid, positions: Tensor, inside: Tensor, fields: list[Tensor]) -> tuple[Tensor, Tensor]:
    """The surface around `inside` (count,): vertices (V, 3), faces (F, 3).

    A vertex lies where the first of the fields becomes 0 along its edge: marching their minimum instead would pull
    the visible surface inward wherever another field is the smaller one at the inner end.
    """
    shape = (grid.side, grid.side, grid.side)
    edges, faces = crossing_faces(inside.view(shape))
    lower, upper = edge_ends(edges, shape)
    inner = torch.where(inside[lower], lower, upper)
    outer = torch.where(inside[lower], upper, lower)
    fraction = torch.full((len(edges),), torch.inf)
    for field in fields:
        crossed = (field[outer] <= 0) & (field[inner] > 0)  # a filled pocket has ends where neither is positive
        first = crossing_fraction(field[inner], field[outer].clamp(max=0), grid.spacing)
        fraction = torch.where(crossed, torch.minimum(fraction, first), fraction)
    start = positions[inner]
    return start + fraction[:, None] * (positions[outer] - start), faces
