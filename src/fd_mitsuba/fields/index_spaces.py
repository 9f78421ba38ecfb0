"""Numbers of what: the index spaces that meet where a part is evaluated and extracted, a type each.

All are int64 tensors; the types exist for readers and for the type checker, which takes none for another:

    GridVertices   vertices of the tetrahedral grid, (z * side + y) * side + x        0 ... count - 1
    BoxVertices    vertices of the box around the part, numbered likewise within it   0 ... M - 1
    Sites          active vertices in the order of `LatticeSites.index`               0 ... A - 1
    GridEdges      edges of the grid, lower vertex * 8 + direction
    BoxEdges       edges of the box, likewise in its numbers
    TableRows      rows of a hash grid's table, all levels one after another

        grid   . . . . . . . .        box   . . . . .        sites   the o, and no others;
               . . . o o . . .              . . o o .                -1 stands for a vertex that is none
               . . o o o . . .              . o o o .
               . . . . . . . .              . . . . .

What arithmetic or indexing makes of them is a plain tensor until it is given a type again.
"""

from __future__ import annotations

from typing import NewType

from torch import Tensor

GridVertices = NewType("GridVertices", Tensor)
BoxVertices = NewType("BoxVertices", Tensor)
Sites = NewType("Sites", Tensor)
GridEdges = NewType("GridEdges", Tensor)
BoxEdges = NewType("BoxEdges", Tensor)
TableRows = NewType("TableRows", Tensor)
