"""The frame of the normal perturbation: orthonormal, smooth, and the same in numpy and in Dr.Jit."""

from __future__ import annotations

from typing import Any

import numpy as np

from fd_mitsuba.fields.tangent_frame import REFERENCE_AXIS, tangent_frame


def directions(count: int = 2000) -> np.ndarray:
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    vectors = np.concatenate([vectors, np.eye(3), -np.eye(3)])
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_frames_are_orthonormal_and_right_handed() -> None:
    normal = directions()
    tangent, bitangent = tangent_frame(normal)
    for vectors in (tangent, bitangent):
        assert np.abs(np.linalg.norm(vectors, axis=1) - 1).max() < 1e-9
        assert np.abs(np.einsum("ij,ij->i", vectors, normal)).max() < 1e-9
    assert np.abs(np.cross(tangent, bitangent) - normal).max() < 1e-9


def test_frames_change_little_with_the_normal_and_stay_finite_opposite_to_the_axis() -> None:
    normal = directions()
    axis = np.array(REFERENCE_AXIS) / np.linalg.norm(REFERENCE_AXIS)
    normal = normal[normal @ axis > -0.9]
    moved = normal + 1e-5 * np.roll(normal, 1, axis=1)
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    assert np.abs(tangent_frame(moved)[0] - tangent_frame(normal)[0]).max() < 2e-4
    assert np.isfinite(tangent_frame(-axis[None])).all()


def test_mitsuba_side_agrees(mi: Any) -> None:
    from fd_mitsuba.render.shading_frame import bent_frame
    from fd_mitsuba.render.shading_frame import tangent_frame as in_drjit

    normal = directions(200)
    vector = mi.Vector3f(np.ascontiguousarray(normal.T, dtype=np.float32))
    expected = tangent_frame(normal)
    for found, values in zip(in_drjit(vector), expected, strict=True):
        assert np.abs(np.array(found).T - values).max() < 1e-4
    slope = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    frame = bent_frame(vector, mi.Vector3f(*(2 * slope).tolist()), vector)
    bent = slope[0] * expected[0] + slope[1] * expected[1] + slope[2] * normal
    assert np.abs(np.array(frame.n).T - bent).max() < 1e-4
    assert np.abs(np.array(bent_frame(vector, mi.Vector3f(0, 0, 1), vector).n).T - normal).max() < 1e-5


def test_a_normal_that_faces_away_is_turned_back_to_the_viewer(mi: Any) -> None:
    from fd_mitsuba.render.shading_frame import bent_frame

    normal = directions(200)
    viewer = np.roll(normal, 1, axis=0)
    as_vector = [mi.Vector3f(np.ascontiguousarray(v.T, dtype=np.float32)) for v in (normal, viewer)]
    frame = bent_frame(as_vector[0], mi.Vector3f(3.0, -2.0, 0.1), as_vector[1])
    axes = [np.array(axis).T for axis in (frame.s, frame.t, frame.n)]
    assert np.einsum("ij,ij->i", axes[2], viewer).min() > 0.005
    assert np.abs(np.cross(axes[0], axes[1]) - axes[2]).max() < 1e-4
