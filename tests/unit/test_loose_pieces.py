"""What a cut leaves without a hold, by shapes whose pieces and volumes are known."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest

from fd_mitsuba.export.cut_shapes import CutBase
from fd_mitsuba.export.loose_pieces import LoosePieces, bodies, loose_pieces
from fd_mitsuba.export.solid.cut_base import CutMesh, cut_mesh
from fd_mitsuba.export.solid.solid import Solid
from fd_mitsuba.scene.triangle_mesh import TriangleMesh


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> manifold3d.Manifold:
    return manifold3d.Manifold.cube([b - a for a, b in zip(low, high, strict=True)]).translate(low)


def solid(shape: manifold3d.Manifold) -> Solid:
    mesh = shape.to_mesh64()
    return Solid(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, dtype=np.int64))


def together(*shapes: manifold3d.Manifold) -> Solid:
    """Bodies in one mesh, which may overlap."""
    parts, start, vertices, faces = [solid(shape) for shape in shapes], 0, [], []
    for part in parts:
        vertices.append(part.vertices)
        faces.append(part.faces + start)
        start += len(part.vertices)
    return Solid(np.concatenate(vertices), np.concatenate(faces))


def after(whole: Solid, tool: manifold3d.Manifold, removed: float) -> tuple[CutMesh, LoosePieces]:
    cut = cut_mesh("shape", whole.vertices, whole.faces, np.zeros((len(whole.vertices), 0)), solid(tool))
    body = np.where(cut.source < 0, -1, bodies(whole.vertices, whole.faces)[cut.source])
    return cut, loose_pieces(cut.vertices, cut.faces, body, (), removed)


def volume(cut: CutMesh, faces: np.ndarray) -> float:
    return TriangleMesh("left", cut.vertices, faces).volume()


BAR = block((0, 0, 0), (4, 1, 1))
WIDE = (-1, -1)


def slab(low: float, high: float) -> manifold3d.Manifold:
    return block((low, *WIDE), (high, 2, 2))


def test_a_small_end_goes_and_a_large_one_is_counted() -> None:
    cut, found = after(solid(BAR), slab(3.0, 3.9), 0.9)
    assert not found.large and [one.volume for one in found.solids] == pytest.approx([0.1])
    assert volume(cut, cut.faces[~found.crumb]) == pytest.approx(3.0)
    _, found = after(solid(BAR), slab(3.0, 3.5), 0.5)
    assert found.large == 1 and not found.solids and not found.crumb.any()


def test_the_wall_of_a_cavity_is_no_piece() -> None:
    hollow = block((0, 0, 0), (4, 4, 4)) - block((1, 1, 1), (3, 3, 3))
    horn = block((1.5, 1.5, 3.9), (2.5, 2.5, 8.0))
    cut, found = after(solid(hollow + horn), block((1, 1, 4.5), (3, 3, 7.9)), 3.4)
    assert len(found.solids) == 1 and found.solids[0].volume == pytest.approx(0.1)
    assert volume(cut, cut.faces[~found.crumb]) == pytest.approx(56.5)
    within = block((0.2, 0.2, 0.2), (0.8, 0.8, 0.8))
    cut, found = after(solid(BAR), within, 0.216)
    assert not found.large and not found.crumb.any() and volume(cut, cut.faces) == pytest.approx(4 - 0.216)


def test_a_crumb_takes_its_own_cavity_along() -> None:
    bar = BAR - block((3.92, 0.4, 0.4), (3.98, 0.6, 0.6))
    cut, found = after(solid(bar), slab(3.0, 3.9), 0.9)
    assert len(found.solids) == 1 and volume(cut, cut.faces[~found.crumb]) == pytest.approx(3.0)
    assert set(np.unique(bodies(cut.vertices, cut.faces[~found.crumb]))) == {0}


def test_what_sits_in_another_body_is_held() -> None:
    """A ball on the bar's end, as two bodies of one mesh: the bar's short end stays in it."""
    head = block((3.8, -0.5, -0.5), (5.0, 1.5, 1.5))
    for whole, others in ((together(BAR, head), ()), (solid(BAR), [solid(head)])):
        cut = cut_mesh("s", whole.vertices, whole.faces, np.zeros((len(whole.vertices), 0)), solid(slab(3.0, 3.7)))
        body = np.where(cut.source < 0, -1, bodies(whole.vertices, whole.faces)[cut.source])
        beside = [(one.vertices, one.faces) for one in others]
        found = loose_pieces(cut.vertices, cut.faces, body, beside, 0.7)
        assert not found.large and not found.crumb.any()


def test_pieces_in_the_places_of_crumbs_go_from_another_surface_too() -> None:
    ring = block((-2, -2, 0), (2, 2, 1)) - block((-1, -1, -1), (1, 1, 2))
    middle, main = block((-0.3, -0.3, 0.2), (0.3, 0.3, 0.8)), block((-9, -9, -9), (9, 9, -3))
    cut = CutBase((), (), {}, (), {}, {}, (solid(ring),))
    left = cut.without_crumbs(together(ring.translate((0.01, 0, 0)), middle, main), 0.05)
    assert left.volume == pytest.approx(middle.volume() + main.volume())
