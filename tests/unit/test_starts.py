"""Ellipsoids that stand for a part before it has grown."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.data.primitives import Solid
from fd_mitsuba.prior.data.starts import starts_like


def pieces(solid: Solid) -> list[trimesh.Trimesh]:
    return list(trimesh.Trimesh(solid.vertices, solid.faces, process=True).split(only_watertight=False))


@pytest.mark.parametrize(("body", "part", "most"), [("horse", "wings", 2), ("mug", "handle", 1), ("cat", "crown", 1)])
def test_a_start_is_where_the_part_is_and_about_as_large(body: str, part: str, most: int) -> None:
    counts = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        grown = PARTS[part](BODIES[body](rng), rng)
        start = starts_like(grown, rng)
        found = pieces(start)
        counts.append(len(found))
        for piece in found:
            assert piece.is_watertight and piece.volume > 0  # faces wind outward
            assert piece.convex_hull.volume == pytest.approx(piece.volume, rel=1e-6)  # smooth and round
        centre, size = (start.vertices.max(0) + start.vertices.min(0)) / 2, np.ptp(start.vertices, axis=0).max()
        assert np.abs(centre - (grown.vertices.max(0) + grown.vertices.min(0)) / 2).max() < 0.5
        assert 0.4 < size / np.ptp(grown.vertices, axis=0).max() < 2
    assert max(counts) == most and (most == 1 or counts.count(2) > 10)  # a pair has mostly an ellipsoid on each side
    assert np.array_equal(
        starts_like(grown, np.random.default_rng(3)).vertices, starts_like(grown, np.random.default_rng(3)).vertices
    )
