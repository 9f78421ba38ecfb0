"""The cut between edited and untouched voxels: the cheapest set of edges that parts seeds of one from the other.

The original takes PyMaxflow, whose licence (GPL) this package cannot carry; SciPy's maximum flow finds the same cut.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

_UNIT = 1000
"""Capacities are whole numbers: so many for a cost of 1."""
_HELD = 1 << 28
"""Of an edge to a seed: more than any cut costs."""


def cut_labels(edges: np.ndarray, costs: np.ndarray, count: int, edit: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(count,) bool: the nodes on the edit's side of the cheapest cut.

    Args:
        edges: (E, 2) nodes that are neighbours, each pair once.
        costs: (E,) >= 0, of parting them.
        edit, rest: (.,) nodes of which the side is known; a node in both is the rest's. What no path joins to a seed of
            the edit is the rest's.
    """
    edit = np.setdiff1d(edit, rest)
    if not len(edit):
        return np.zeros(count, dtype=bool)
    source, sink = count, count + 1
    capacity = np.round(costs * _UNIT).astype(np.int32)
    starts = np.concatenate([edges[:, 0], edges[:, 1], np.full(len(edit), source), rest])
    ends = np.concatenate([edges[:, 1], edges[:, 0], edit, np.full(len(rest), sink)])
    values = np.concatenate([capacity, capacity, np.full(len(edit) + len(rest), _HELD, dtype=np.int32)])
    graph = csr_array(coo_array((values, (starts, ends)), shape=(count + 2, count + 2)), dtype=np.int32)
    flow = maximum_flow(graph, source, sink).flow
    left = csr_array(graph - flow)
    left.data = (left.data > 0).astype(np.int32)
    left.eliminate_zeros()
    reached = breadth_first_order(left, source, return_predecessors=False)
    labels = np.zeros(count + 2, dtype=bool)
    labels[reached] = True
    return labels[:count]


def lattice_edges(occupied: np.ndarray) -> np.ndarray:
    """(E, 2) pairs of neighbouring nodes: an occupied voxel (z, y, x) is numbered in the order of `np.flatnonzero`."""
    number = np.full(occupied.shape, -1, dtype=np.int64)
    number[occupied] = np.arange(int(occupied.sum()))
    pairs = []
    for axis in range(3):
        one, other = (np.moveaxis(number, axis, 0)[rows] for rows in (slice(None, -1), slice(1, None)))
        both = (one >= 0) & (other >= 0)
        pairs.append(np.stack([one[both], other[both]], axis=1))
    return np.concatenate(pairs)
