"""Edges of one chart that lie side by side in the picture: split where the surface is not, left alone where it is."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.export.bake.chart_notches import charts_of, open_notches

DENSITY = 100.0


def strip(turn: float, count: int = 60, width: float = 0.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and places of a ring-shaped strip whose ends are `turn` texels apart in the picture.

    On the surface it is straight, so that its ends are as far from each other as they can be.
    """
    share = np.linspace(0, 1, count)
    angle = share * (2 * np.pi - turn / DENSITY)
    rim = [np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius for radius in (1.0, 1.0 + width)]
    flat = np.stack(rim, axis=1).reshape(-1, 2)
    length = share * 2 * np.pi
    vertices = np.stack([np.stack([length, 0 * length + y, 0 * length], axis=1) for y in (0, width)], axis=1)
    first = 2 * np.arange(count - 1)
    faces = np.concatenate([np.stack([first, first + 1, first + 2], 1), np.stack([first + 1, first + 3, first + 2], 1)])
    return vertices.reshape(-1, 3), faces, flat


def nearest_of_far(vertices: np.ndarray, faces: np.ndarray, flat: np.ndarray) -> float:
    """The least distance in texels, within one chart, of corners that are more than 1 apart on the surface."""
    chart = charts_of(faces, len(flat))
    near = np.linalg.norm(flat[:, None] - flat[None], axis=-1) * DENSITY
    far = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1) > 1
    return float(near[far & (chart[:, None] == chart[None])].min())


@pytest.mark.parametrize("turn", [0.5, 2.0])
def test_ends_that_are_far_apart_do_not_stay_side_by_side(turn: float) -> None:
    vertices, faces, flat = strip(turn)
    every = np.arange(len(vertices))
    assert nearest_of_far(vertices, faces, flat) < 3
    vertex_map, split, places = open_notches(vertices, every, faces, flat, DENSITY)
    assert nearest_of_far(vertices[vertex_map], split, places) > 3
    assert np.array_equal(vertex_map[split], faces)
    before, after = (
        np.linalg.norm(p[f] - np.roll(p[f], 1, axis=1), axis=-1) for p, f in ((flat, faces), (places, split))
    )
    assert np.allclose(before, after, atol=1e-9)  # moved, not bent


def test_a_wide_gap_stays() -> None:
    vertices, faces, flat = strip(8.0)
    _, split, places = open_notches(vertices, np.arange(len(vertices)), faces, flat, DENSITY)
    assert np.array_equal(split, faces) and np.array_equal(places, flat)


def test_a_slit_in_a_flat_surface_stays() -> None:
    _, faces, flat = strip(0.5)
    surface = np.pad(flat, ((0, 0), (0, 1)))  # what is near in the picture is near in space
    _, split, places = open_notches(surface, np.arange(len(surface)), faces, flat, DENSITY)
    assert np.array_equal(split, faces) and np.array_equal(places, flat)
