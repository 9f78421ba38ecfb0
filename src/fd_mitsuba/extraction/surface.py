"""The surface of base and part together, extracted again each step at the cost of the part's neighbourhood.

Only *active* vertices of the grid, those near the focal regions, know the part; elsewhere `sdf_part` is the constant
`FAR_OUTSIDE`, so the union there is the base, exactly, and its triangles are extracted once. A step then

1. finds the signs at all active vertices, without gradients, and with them the topology (`site_signs`);
2. evaluates `sdf_part`, with gradients, at the ends of crossed edges and at the caller's samples, which are the only
   vertices that a loss can reach;
3. joins the result with the base's triangles into one welded mesh.

`SurfaceExtractor.extract_plain` does the same the long way round and is the oracle of the tests.

What a surface is put together from (`fields.index_spaces` has the numbers of vertices and edges):

    vertices   | static: on edges without an active end | on edges of the box with one |
               | the base's own, never move             | made anew each step          |
    faces      | static: of cells that touch no active vertex | of the box's other cells, anew each step |

    crossed edge (box) --+-- both ends no site: it is among the static ones, found by its number in the grid
                         +-- else: its two ends --> sites --> rows of `PartValues`, one row for a site however
                                                    many edges end there; an end that is no site has the base's values
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fd_mitsuba.extraction.lattice_box import LatticeBox, touched_cells
from fd_mitsuba.extraction.marching_tets import (
    away_from_crossings,
    crossing_faces,
    crossing_faces_plain,
    edge_ends,
    true_positions,
)
from fd_mitsuba.extraction.site_signs import SiteSigns
from fd_mitsuba.extraction.tet_grid import EDGE_SLOTS, TetGrid
from fd_mitsuba.extraction.union_surface import UnionSurface, faces_of_part, vertices_on_edges
from fd_mitsuba.fields.index_spaces import BoxEdges, BoxVertices, GridEdges, GridVertices, Sites
from fd_mitsuba.fields.lattice_sites import LatticeSites, SiteFeatures
from fd_mitsuba.fields.part_sdf import PartField, PartValues
from fd_mitsuba.fields.union import soft_union

FAR_OUTSIDE = -10.0
"""`sdf_part` where it is not evaluated: below any base sdf by more than any fillet, so that the union is the base."""

_OFFSET_CELLS = 0.5
"""How far an offset may move a vertex along each axis, in cells: two neighbours cannot pass each other."""

Samples = GridVertices | Callable[[Tensor], GridVertices]
"""Active vertices, or what chooses them; see `SurfaceExtractor.__call__`."""


class SurfaceExtractor:
    """Turns a part's field into the surface of its union with a constant base.

    Args:
        grid: the tetrahedral grid.
        sdf_base: (count,) base sdf at its vertices, inside positive, canonical units.
        initial_sdf: (count,) signed distance to the focal regions there, where the part's field starts.
        active_index: (A,) vertices at which the part exists (see `active_vertices`); border vertices are dropped.
        union_k: width of the fillet, canonical units; 0: none.
        union_only_outside: see `soft_union`.
        depth: what callers that choose samples by the part's depth compare with, canonical units; None: no such ones.

    Attributes:
        active_index: (A,) int64 ascending.
        movable: (A,) bool, the active vertices that offsets may move. Deviates from the paper's mask "s_e >= 0", which
            would also let vertices of the base's surface move: a vertex is movable if none of the cells around it
            contains a sign change of the base, so that every triangle of the base's own surface stays as it was.
    """

    def __init__(
        self,
        grid: TetGrid,
        sdf_base: Tensor,
        initial_sdf: Tensor,
        active_index: GridVertices,
        union_k: float = 0.15,
        union_only_outside: bool = False,
        depth: float | None = None,
    ) -> None:
        self.grid = grid
        self.sdf_base = sdf_base.detach()
        self.initial_sdf = initial_sdf.detach()
        self.active_index = GridVertices(active_index[~grid.is_border(active_index)].unique())
        self.union_k = union_k
        self.union_only_outside = union_only_outside
        self._depth = depth
        self._shape = (grid.side, grid.side, grid.side)
        self.movable = away_from_crossings(self.sdf_base.view(self._shape)).view(-1)[self.active_index]
        movable = GridVertices(self.active_index[self.movable])
        self._reach = _OFFSET_CELLS * grid.spacing * self._mark(movable).to(sdf_base.dtype)
        self._box = LatticeBox(grid, self.active_index)
        self._active = self._mark(self.active_index)
        self._box_cells = touched_cells(self._box.cut(self._active))
        self._box_inside = self._box.cut(self.sdf_base > 0).contiguous()
        self._box_base = self.sdf_base[self._box.vertices]
        self._box_positions = grid.positions(self._box.vertices, sdf_base.dtype)
        self._box_reach = self._reach[self._box.vertices, None]
        self._lookup = torch.empty(EDGE_SLOTS * len(self._box.vertices), dtype=torch.int32)
        self._sites: LatticeSites | None = None
        self._prepare_static()

    def __call__(self, field: PartField, samples: Samples | None = None) -> UnionSurface:
        """The union's surface for the field's present parameters.

        Args:
            field: the part; all calls must use the same hash grid layout.
            samples: (S,) active vertices, in any order, repeats allowed, at which `sample_sdf` is wanted; or a function
                that chooses them by whether (A,) the part is deeper than `depth` at `active_index`.
        """
        sites, features = self._site_features(field)
        edges, faces = self._crossings(self._signs.update(field, features))
        if callable(samples):
            samples = samples(self._at_active(self._signs.deeper))
        lower, upper = edge_ends(edges, self._box.shape)
        is_fixed = (self._box_site.index_select(0, lower) < 0) & (self._box_site.index_select(0, upper) < 0)
        fixed, free = true_positions(is_fixed), true_positions(~is_fixed)
        places = torch.empty(len(edges), dtype=torch.int64)
        places[fixed] = torch.searchsorted(self._static_edges, self._box.grid_edges(BoxEdges(edges[fixed])))
        lower, upper = lower.index_select(0, free), upper.index_select(0, free)
        places.index_copy_(0, free, torch.arange(len(lower)) + len(self._static_edges))
        ends, position = self._box.unique(BoxVertices(torch.cat([lower, upper])))
        values, end_sites, sample_sdf = self._values_with_gradient(field, sites, features, ends, samples)
        vertices, part_weight = self._surface_vertices(ends, values, end_sites, position.view(2, -1))
        part_weight = torch.cat([part_weight.new_zeros(len(self._static_vertices)), part_weight])
        faces = places.index_select(0, faces.view(-1)).view(-1, 3)
        is_part = torch.cat([self._static_is_part, faces_of_part(part_weight, faces)])
        vertices = torch.cat([self._static_vertices, vertices])
        return UnionSurface(vertices, torch.cat([self._static_faces, faces]), part_weight, is_part, sample_sdf)

    def extract_plain(self, field: PartField, samples: GridVertices | None = None) -> UnionSurface:
        """The same surface, vertices in another order, from the field at all vertices and all tetrahedra."""
        everything = GridVertices(torch.arange(self.grid.count))
        everywhere = field.evaluate(self.grid.positions(everything, self.sdf_base.dtype), self.initial_sdf)
        sdf_part = torch.where(self._active, everywhere.sdf, FAR_OUTSIDE)
        union = soft_union(self.sdf_base, sdf_part, self.union_k, self.union_only_outside)
        moved = self._moved(everything, everywhere.offset)
        ends, faces = crossing_faces_plain(union.detach() > 0, self.grid.tets())
        vertices, part_weight = vertices_on_edges(moved, union, sdf_part - self.sdf_base, ends.t(), self.grid.spacing)
        sample_sdf = sdf_part[:0] if samples is None else sdf_part[samples]
        return UnionSurface(vertices, faces, part_weight, faces_of_part(part_weight, faces), sample_sdf)

    @torch.no_grad()
    def lattice_values(self, field: PartField) -> tuple[Tensor, Tensor]:
        """`sdf_part` (count,), `FAR_OUTSIDE` where there is none, and the moved vertices (count, 3); no gradients."""
        sites, features = self._site_features(field)
        values = field.site_values(sites, features, Sites(torch.arange(len(sites))), self._site_initial)
        sdf = self.sdf_base.new_full((self.grid.count,), FAR_OUTSIDE)
        sdf[sites.index] = values.sdf
        offset = sdf.new_zeros(self.grid.count, 3)
        offset[sites.index] = values.offset
        return sdf, self._moved(GridVertices(torch.arange(self.grid.count)), offset)

    @torch.no_grad()
    def extract_part(self, field: PartField, other_sdf: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The part alone, a closed solid: vertices (V, 3), faces (F, 3) of the zero set of `sdf_part`; no gradients.

        Args:
            field: the part.
            other_sdf: (count,) limits it to `min(sdf_part, other_sdf)`, which cuts out one of several named parts.
        """
        sdf, moved = self.lattice_values(field)
        sdf = sdf if other_sdf is None else torch.minimum(sdf, other_sdf)
        edges, faces = crossing_faces(sdf.view(self._shape) > 0)
        ends = torch.stack(edge_ends(edges, self._shape))
        return vertices_on_edges(moved, sdf, sdf, ends, self.grid.spacing)[0], faces

    @property
    def static_faces(self) -> int:
        """How many faces at the head of every surface's list are the base's own and never change."""
        return len(self._static_faces)

    @property
    def static_vertices(self) -> int:
        """How many vertices at the head of every surface's list are the base's own: those of the static faces."""
        return len(self._static_vertices)

    @torch.no_grad()
    def part_sdf(self, field: PartField) -> Tensor:
        """`sdf_part` (A,) at `active_index`, without gradients."""
        sites, features = self._site_features(field)
        return self._at_active(field.site_sdf(features, Sites(torch.arange(len(sites))), self._site_initial))

    def _at_active(self, at_sites: Tensor) -> Tensor:
        return at_sites.index_select(0, self._site_of_active)

    def _prepare_static(self) -> None:
        """What the base contributes whatever the part does: edges without, and cells without, an active end."""
        inside = self.sdf_base.view(self._shape) > 0
        edges, _ = crossing_faces(inside)
        ends = torch.stack(edge_ends(edges, self._shape))
        still = ~self._active[ends].any(dim=0)
        self._static_edges = GridEdges(edges[still])
        used, position = ends[:, still].unique(return_inverse=True)
        used = GridVertices(used)
        base = self.sdf_base[used]
        positions = self.grid.positions(used, base.dtype)
        self._static_vertices, _ = vertices_on_edges(positions, base, base, position, self.grid.spacing)
        cell_edges, faces = crossing_faces(inside, ~touched_cells(self._active.view(self._shape)))
        self._static_faces = torch.searchsorted(self._static_edges, cell_edges)[faces]
        self._static_is_part = torch.zeros(len(faces), dtype=torch.bool)

    def _site_features(self, field: PartField) -> tuple[LatticeSites, SiteFeatures]:
        if self._sites is None:  # the field's layout is known only now; everything here is constant from then on
            self._sites = field.sites(self.grid.axis, self.active_index)
            self._site_initial = self.initial_sdf[self._sites.index]
            self._site_box = self._box.local(self._sites.index)
            self._box_site = torch.full((len(self._box.vertices),), -1, dtype=torch.int32)
            self._box_site[self._site_box] = torch.arange(len(self._sites), dtype=torch.int32)
            self._site_of_active = Sites(self._box_site[self._box.local(self.active_index)].long())
            base = self.sdf_base[self._sites.index]
            self._signs = SiteSigns(base, self._site_initial, self.union_k, self.union_only_outside, self._depth)
        return self._sites, field.site_features(self._sites)

    def _crossings(self, changed: Sites) -> tuple[BoxEdges, Tensor]:
        """The crossed edges, in the box's numbers, and the faces of its cells that touch a site.

        Args:
            changed: (N,) the sites whose signs may be others than at the last call.
        """
        if len(self._site_box) == 0:
            return BoxEdges(self._static_edges[:0]), self._static_faces[:0]
        self._box_inside.view(-1)[self._site_box[changed]] = self._signs.inside[changed]
        edges, faces = crossing_faces(self._box_inside, self._box_cells, self._lookup)
        return BoxEdges(edges), faces

    def _values_with_gradient(
        self,
        field: PartField,
        sites: LatticeSites,
        features: SiteFeatures,
        ends: BoxVertices,
        samples: GridVertices | None,
    ) -> tuple[PartValues, Tensor, Tensor]:
        """The field at the sites among `ends` and `samples` (one evaluation), and where each of them is in it.

        Returns the values, the position in them of each end (-1: not active), and `sample_sdf`.
        """
        end_sites = self._box_site.index_select(0, ends).long()
        sample_sites = end_sites[:0] if samples is None else self._box_site[self._local_samples(samples)].long()
        wanted = torch.zeros(len(sites) + 1, dtype=torch.bool)
        wanted.numpy()[torch.cat([end_sites, sample_sites]).numpy()] = True  # ends that are no site mark the last entry
        chosen = Sites(true_positions(wanted[:-1]))
        position = torch.full((len(sites) + 1,), -1, dtype=torch.int64)  # the last entry serves ends that are no site
        position.index_copy_(0, chosen, torch.arange(len(chosen)))
        values = field.site_values(sites, features, chosen, self._site_initial.index_select(0, chosen))
        end_values = torch.from_numpy(position.numpy()[end_sites.numpy()])  # several times as fast as torch
        return values, end_values, values.sdf.index_select(0, position[sample_sites])

    def _local_samples(self, samples: GridVertices) -> BoxVertices:
        if not self._active[samples].all():
            raise ValueError("samples must be taken from active_index")
        return self._box.local(samples)

    def _surface_vertices(
        self, ends: BoxVertices, values: PartValues, end_values: Tensor, edges: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Vertices and part_weight on `edges` (2, E), pairs of places in `ends` (M,), which are numbers in the box.

        `end_values` (M,) is the place of each end in `values`, or -1.
        """
        known = true_positions(end_values >= 0)
        source = end_values.index_select(0, known)
        base = self._box_base.index_select(0, ends)
        sdf_part = torch.full_like(base, FAR_OUTSIDE).index_copy(0, known, values.sdf.index_select(0, source))
        offset = base.new_zeros(len(ends), 3).index_copy(0, known, values.offset.index_select(0, source))
        union = soft_union(base, sdf_part, self.union_k, self.union_only_outside)
        moved = self._box_positions.index_select(0, ends) + offset * self._box_reach.index_select(0, ends)
        return vertices_on_edges(moved, union, sdf_part - base, edges, self.grid.spacing)

    def _mark(self, index: GridVertices) -> Tensor:
        return torch.zeros(self.grid.count, dtype=torch.bool).index_fill_(0, index, True)

    def _moved(self, index: GridVertices, offset: Tensor) -> Tensor:
        """Positions of the grid's vertices after the offsets, (M, 3); those that must not move are exact."""
        return self.grid.positions(index, offset.dtype) + offset * self._reach[index, None].to(offset.dtype)
