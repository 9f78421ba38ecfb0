"""Shapes that are known, from outlines drawn by ray tracing of another library's making: closed forms on film."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.config import FieldConfig
from fd_mitsuba.fields.part_sdf import PartField
from fd_mitsuba.fields.visual_hull import explained, hull_sdf, support
from fd_mitsuba.render.point_views import point_views
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.field_fit import fit_field

SIZE, SIDE, SPACING = 32, 41, 0.04
AXIS = (np.arange(SIDE) - SIDE // 2) * SPACING
POINTS = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
CAMERAS = CameraBatch.around(90.0 * np.arange(4), 15.0, 3.0, 36.0)


@pytest.fixture(scope="module", autouse=True)
def _mitsuba(mi: object) -> None:
    """What renders needs a variant."""


def outlines(radius: float, centre: tuple[float, float, float]) -> np.ndarray:
    """Coverage (B, H, H) of a ball by 8 x 8 rays a pixel: a ray meets it if it passes its centre closely enough."""
    pictures = []
    right, up, back = CAMERAS.basis()
    fine = 8 * SIZE
    place = (np.arange(fine) + 0.5) / fine * 2 - 1
    for k in range(len(CAMERAS)):
        half = np.tan(np.radians(CAMERAS.fov_deg[k]) / 2)
        x, y = np.meshgrid(place * half, -place * half)
        ray = x[..., None] * right[k] + y[..., None] * up[k] - back[k]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        to_centre = np.array(centre) - CAMERAS.position[k]
        off = np.linalg.norm(to_centre - (ray @ to_centre)[..., None] * ray, axis=-1)
        pictures.append((off < radius).reshape(SIZE, 8, SIZE, 8).mean((1, 3)))
    return np.array(pictures)


def triangle_far_away() -> tuple[np.ndarray, np.ndarray]:
    return np.array([[9.0, 9, 9], [9.1, 9, 9], [9, 9.1, 9]]), np.array([[0, 1, 2]])


@pytest.mark.parametrize("radius, centre", [(0.4, (0.0, 0.0, 0.0)), (0.15, (0.2, 0.1, -0.2))])
def test_a_ball_is_within_its_hull_and_the_hull_is_not_much_more(
    radius: float, centre: tuple[float, float, float]
) -> None:
    views = point_views(*triangle_far_away(), CAMERAS, SIZE, POINTS)
    known = support(outlines(radius, centre), views.film, views.seen).reshape((SIDE,) * 3)
    anywhere = np.ones(known.shape, dtype=bool)
    cells = hull_sdf(known, anywhere, ~anywhere).ravel()
    distance = (radius - np.linalg.norm(POINTS - centre, axis=1)) / SPACING
    assert (cells[distance > 1] > 0).all()
    assert (cells[distance < -radius / SPACING - 2] < 0).all()
    assert 1.0 < (cells > 0).sum() / (distance > 0).sum() < 1.6  # four outlines leave corners
    facing = np.abs(POINTS - centre)[:, 1] < 0.3 * radius
    on_axis = facing & (np.abs(POINTS - centre)[:, 0] < 0.02) & (np.abs(cells) < 1)  # towards a camera: no corner there
    assert on_axis.any() and np.abs(cells - distance)[on_axis].mean() < 1.0


def test_what_the_base_hides_says_nothing() -> None:
    """A wall before the first camera's half of the space: its empty picture takes nothing away behind it."""
    wall = trimesh.creation.box((2.0, 2.0, 0.02), trimesh.transformations.translation_matrix((0, 0, 0.5)))
    views = point_views(wall.vertices, wall.faces, CAMERAS, SIZE, POINTS)
    behind = POINTS[:, 2] < 0.4
    in_front = POINTS[:, 2] > 0.6
    assert not views.seen[0][behind].any() and views.seen[0][in_front].any()
    near = np.linalg.norm(POINTS, axis=1) < 0.2
    assert views.seen[2][near].all()  # from the other side
    pictures = outlines(0.4, (0.0, 0.0, 0.0))
    pictures[0] = 0
    assert np.nanmin(support(pictures, views.film, views.seen)[near]) > 0.9
    free = point_views(*triangle_far_away(), CAMERAS, SIZE, POINTS)
    assert support(pictures, free.film, free.seen)[near].max() == 0


def test_points_land_where_the_cameras_formula_puts_them() -> None:
    """position + depth (slope_x right + slope_y up - back) is the point again."""
    views = point_views(*triangle_far_away(), CAMERAS, SIZE, POINTS[::997])
    right, up, back = CAMERAS.basis()
    for k in range(len(CAMERAS)):
        half = np.tan(np.radians(CAMERAS.fov_deg[k]) / 2)
        slope = (views.film[k] / SIZE * 2 - 1) * [half, -half]
        offset = POINTS[::997] - CAMERAS.position[k]
        depth = -(offset @ back[k])
        assert np.allclose(offset @ right[k], slope[:, 0] * depth, atol=1e-4)
        assert np.allclose(offset @ up[k], slope[:, 1] * depth, atol=1e-4)


def test_pictures_of_one_shape_are_explained_and_those_of_several_are_not() -> None:
    views = point_views(*triangle_far_away(), CAMERAS, SIZE, POINTS)
    one = outlines(0.15, (0.2, 0.1, -0.2))
    several = np.stack([outlines(0.15, (0.35 * k - 0.5, 0.45 - 0.3 * k, -0.2))[k] for k in range(len(CAMERAS))])
    anywhere = np.ones((SIDE,) * 3, dtype=bool)
    shares = []
    for pictures in (one, several):
        known = support(pictures, views.film, views.seen).reshape(anywhere.shape)
        within = hull_sdf(known, anywhere, ~anywhere).ravel() > -0.5
        shares.append(explained(pictures, views.film, views.seen & within))
    assert shares[0] > 0.95 and shares[1] < 0.2
    assert explained(np.zeros_like(one), views.film, views.seen) == 0


def test_what_fewer_than_two_views_see_is_unknown_and_a_hull_of_nothing_is_nothing() -> None:
    seen = np.array([[True, True, False], [True, False, False]])
    film = np.full((2, 3, 2), 4.0)
    found = support(np.full((2, 8, 8), 0.7), film, seen)
    assert found[0] == pytest.approx(0.7) and np.isnan(found[1:]).all()
    empty = np.zeros((4, 4, 4), dtype=bool)
    assert (hull_sdf(np.zeros((4, 4, 4)), ~empty, empty) < 0).all()
    assert (hull_sdf(np.full((4, 4, 4), np.nan), empty, ~empty) < 0).all()


def test_what_covers_no_pixel_by_half_stays() -> None:
    """A ball as wide as half a pixel, at the meeting point of pixels: it covers a twentieth of each of four."""
    centre = (0.0, 0.0, 0.0)
    pictures = outlines(0.02, centre)
    assert 0 < pictures.max() < 0.2
    pictures *= 0.4 / pictures.max()  # what a network draws of it
    views = point_views(*triangle_far_away(), CAMERAS, SIZE, POINTS)
    known = support(pictures, views.film, views.seen).reshape((SIDE,) * 3)
    anywhere = np.ones(known.shape, dtype=bool)
    cells = hull_sdf(known, anywhere, ~anywhere).ravel()
    assert (cells > 0).any() and np.linalg.norm(POINTS[cells > 0], axis=1).max() < 3 * SPACING


def test_a_field_is_fitted_to_a_shape() -> None:
    points = torch.from_numpy(POINTS).float()
    target = 0.3 - (points - torch.tensor([0.1, 0.0, 0.0])).norm(dim=1)
    start = 0.5 - points.norm(dim=1)
    field = PartField(FieldConfig(levels=6, finest_resolution=28), seed=1)
    error = fit_field(field, points, start, target, SPACING, seed=2)
    with torch.no_grad():
        sdf = field.evaluate(points, start).sdf
    near = target.abs() < 2 * SPACING
    assert error < 0.2 and (sdf - target)[near].abs().mean() < 0.2 * SPACING
    assert ((sdf > 0) == (target > 0))[~near].float().mean() > 0.999
    again = PartField(FieldConfig(levels=6, finest_resolution=28), seed=1)
    fit_field(again, points, start, target, SPACING, seed=2)
    assert all(torch.equal(*pair) for pair in zip(field.parameters(), again.parameters(), strict=True))
    with pytest.raises(ValueError, match="no surface"):
        fit_field(again, points, start, torch.full_like(target, -1.0), SPACING, seed=2)
