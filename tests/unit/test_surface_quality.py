"""Measures of a surface on shapes of which the right value is known."""

from __future__ import annotations

import numpy as np
import pytest
from test_remesh import ball, cube, marched, remeshed

from fd_mitsuba.evaluation.joint import joint_curves, measure_joint
from fd_mitsuba.export.bake.shading_noise import surface_noise, widened_roughness
from fd_mitsuba.export.final_surface.shading import smooth_normals
from fd_mitsuba.export.final_surface.triangle_angles import smallest_angles
from fd_mitsuba.scene.mesh_distance import MeshDistance
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.vertex_normals import vertex_normals

CELL = 2 / 64
BOX = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
       [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
"""The faces of a box whose corners are numbered with z the fastest."""


def test_angles_of_known_triangles() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, np.sqrt(0.75), 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [0, 0, 1]])
    assert smallest_angles(vertices, faces) == pytest.approx([45, 60, 0, 0], abs=1e-9)


def test_a_smooth_ball_has_no_noise_and_what_is_put_on_it_is_measured() -> None:
    vertices, faces = unit_sphere(6)
    assert surface_noise(vertices, faces) < 0.05
    rng = np.random.default_rng(0)
    tilt = np.radians(4.0)
    normals = vertices + tilt * rng.normal(size=vertices.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Two components of standard deviation `tilt` across the normal; between vertices half their variance is left.
    whole = 4.0 * np.sqrt(np.pi / 2)
    assert 0.75 * whole * np.sqrt(0.5) < surface_noise(vertices, faces, normals) < whole * np.sqrt(0.5)


def test_facets_are_noise_and_their_density_does_not_matter() -> None:
    plain = [surface_noise(*unit_sphere(level)) for level in (3, 4, 5, 6)]
    assert max(plain) < 0.05
    rough = [surface_noise(*marched(ball, cells)) for cells in (32, 64)]  # slivers bend their neighbours' normals
    assert min(rough) > 3 * max(plain)
    assert surface_noise(*remeshed("ball")) < 0.05


def test_edges_stay_edges() -> None:
    """Remeshing takes what is noise and leaves the cube's edges: the measure of both is known from marching cubes."""
    assert surface_noise(*remeshed("cube")) > 0.8 * surface_noise(*marched(cube))


def waved(amplitude: float, waves: int) -> tuple[np.ndarray, np.ndarray, MeshDistance]:
    """An upright tube through the base's flat top whose end under it is waved, so that the joint is a known curve."""
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    rows = []
    for height in np.linspace(-0.1, 0.1, 21):
        radius = 0.4 + (amplitude * np.cos(waves * angles) if waves else 0.0)
        rows.append(np.stack([radius * np.cos(angles), np.full_like(angles, height), -radius * np.sin(angles)], axis=1))
    vertices = np.concatenate([*rows, [[0, -0.1, 0], [0, 0.1, 0]]])
    index = np.arange(720)
    after, faces = np.roll(index, -1), []
    for row in range(20):
        a, b = row * 720 + index, row * 720 + after
        faces += [np.stack([a, b, b + 720], axis=1), np.stack([a, b + 720, a + 720], axis=1)]
    low, high = len(vertices) - 2, len(vertices) - 1
    faces += [np.stack([after, index, np.full(720, low)], 1)]
    faces += [np.stack([20 * 720 + index, 20 * 720 + after, np.full(720, high)], axis=1)]
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 0.003) for z in (-1, 1)], dtype=float)
    return vertices, np.concatenate(faces), MeshDistance(box, np.array(BOX))


def test_a_round_joint_turns_as_a_circle_does_and_has_no_notch() -> None:
    vertices, faces, base = waved(0.0, 0)
    joint = measure_joint(vertices, faces, base, CELL)
    assert joint.curves == 1 and joint.length == pytest.approx(2 * np.pi * 0.4 / CELL, rel=1e-3)
    assert joint.turning_deg == pytest.approx(np.degrees(CELL / 0.4), rel=0.03)
    assert joint.sideways_deg == pytest.approx(joint.turning_deg, rel=1e-3)  # the base is flat
    assert joint.notches.max() < 0.01
    curve = joint_curves(vertices, faces, base)[0]
    assert np.hypot(curve[:, 0], curve[:, 2]) == pytest.approx(0.4, abs=1e-4)
    assert np.abs(curve[:, 1] - 0.003).max() < 1e-9


def test_teeth_are_turns_and_notches() -> None:
    """Twenty waves of a cell's height around a circle."""
    joint = measure_joint(*waved(CELL, 20), CELL)
    assert joint.curves == 1
    assert 0.8 < joint.notches.max() < 1.3
    assert joint.sideways_notches.max() == pytest.approx(joint.notches.max(), rel=1e-3)  # the base is flat
    # A sine of amplitude A and wavelength L turns by at most 4 pi^2 A / L^2 a length.
    wavelength = 2 * np.pi * 0.4 / 20 / CELL
    steepest = np.degrees(4 * np.pi**2 / wavelength**2)
    assert 0.5 * steepest < np.percentile(joint.turning_deg, 95) < 1.1 * steepest


def test_what_does_not_touch_has_no_joint() -> None:
    vertices, faces, base = waved(0.0, 0)
    joint = measure_joint(vertices + [0, 0.5, 0], faces, base, CELL)
    assert joint.curves == 0 and joint.length == 0 and len(joint.turning_deg) == 0


def test_noise_widens_a_mirror_as_much_as_its_slopes_are_spread() -> None:
    """Two Gaussians one after the other: the variances of the slopes, alpha^2 / 2 an axis, are added."""
    rng = np.random.default_rng(0)
    roughness, slope = 0.1, 0.03
    microfacets = rng.normal(scale=roughness**2 / np.sqrt(2), size=200_000) + rng.normal(scale=slope, size=200_000)
    mean_angle = np.degrees(np.hypot(*rng.normal(scale=slope, size=(2, 200_000)))).mean()
    widened = widened_roughness(np.array([roughness]), mean_angle)
    assert widened[0] == pytest.approx((np.sqrt(2) * microfacets.std()) ** 0.5, rel=0.01)
    assert widened_roughness(np.float32([[0.6]]), mean_angle)[0, 0] == pytest.approx(0.6, abs=0.003)
    assert widened_roughness(np.array([0.2]), 0.0)[0] == pytest.approx(0.2)
    assert widened_roughness(np.array([0.2]), 90.0)[0] == 1


def test_smooth_normals_lose_noise_and_keep_edges() -> None:
    vertices, faces = remeshed("cube")
    normals = smooth_normals(vertices, faces, 2 / 50)
    # Farther from an edge than a triangle is long, a face is flat.
    flat = np.abs(vertices).max(axis=1) - np.sort(np.abs(vertices), axis=1)[:, 1] > 0.06
    assert flat.sum() > 1000
    straight = np.abs(normals[flat]).max(axis=1)
    assert straight.min() > np.cos(np.radians(1))
    rng = np.random.default_rng(0)
    vertices, faces = unit_sphere(5)
    rough = vertices * (1 + 0.002 * rng.normal(size=(len(vertices), 1)))
    noisy, calm = vertex_normals(rough, faces), smooth_normals(rough, faces, 0.1)
    off = [np.degrees(np.arccos(np.einsum("ij,ij->i", n, vertices).clip(-1, 1))).mean() for n in (noisy, calm)]
    assert off[0] > 2 and off[1] < off[0] / 2
