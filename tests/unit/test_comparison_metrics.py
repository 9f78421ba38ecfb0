"""The metrics of a comparison on balls, whose silhouettes, distances and volumes are known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from fd_mitsuba.baselines.drift import image_psnr, leaked_share, outside_regions, surface_chamfer
from fd_mitsuba.baselines.interface import EditedImages
from fd_mitsuba.baselines.table import compare_header, compare_rows
from fd_mitsuba.baselines.view_consistency import view_consistency
from fd_mitsuba.scene.focal_region import FocalRegion
from fd_mitsuba.scene.tessellate import unit_sphere
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch

SIZE = 48
RING = CameraBatch.around(np.arange(8) * 45.0, 30.0, 3.4, 45.0)


def ball(centre: tuple[float, float, float], radius: float) -> TriangleMesh:
    vertices, faces = unit_sphere(4)
    return TriangleMesh("ball", vertices * radius + np.array(centre), faces)


def both(one: TriangleMesh, other: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(
        "both",
        np.concatenate([one.vertices, other.vertices]),
        np.concatenate([one.faces, other.faces + len(one.vertices)]),
    )


def silhouettes(*balls: tuple[tuple[float, float, float], float]) -> torch.Tensor:
    """(8, 1, SIZE, SIZE): pixels whose middle's ray meets a ball, in closed form."""
    right, up, back = RING.basis()
    slope = (np.arange(SIZE) + 0.5) * (2 / SIZE) - 1
    half = np.tan(np.radians(22.5))
    masks = np.zeros((8, SIZE, SIZE), dtype=bool)
    for view in range(8):
        ray = slope[None, :, None] * half * right[view] - slope[:, None, None] * half * up[view] - back[view]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        for centre, radius in balls:
            offset = np.array(centre) - RING.position[view]
            closest = offset - (ray @ offset)[..., None] * ray
            masks[view] |= np.linalg.norm(closest, axis=-1) < radius
    return torch.from_numpy(masks)[:, None].float()


BASE, PART = ((0.0, 0.0, 0.0), 0.5), ((0.0, 0.6, 0.1), 0.25)


def test_views_of_one_object_explain_each_other_and_a_strange_view_is_not_explained() -> None:
    base, edited = silhouettes(BASE), silhouettes(BASE, PART)
    found = view_consistency(edited, base, RING, ball(*BASE))
    assert found.explained > 0.97 and (found.new_pixels > 10).all()
    strange = edited.clone()
    strange[3] = silhouettes(BASE, ((0.95, 0.0, 0.0), 0.15))[3]
    changed = view_consistency(strange, base, RING, ball(*BASE))
    assert changed.per_view[3] < 0.2 and changed.explained < found.explained - 0.1
    nothing = view_consistency(base, base, RING, ball(*BASE))
    assert nothing.explained is None and not nothing.new_pixels.any()


@pytest.fixture
def scene() -> Any:
    to_canonical = np.eye(4)
    to_canonical[:3, :3] *= 0.3
    to_canonical[:3, 3] = (0, 0.6, 0)
    region = FocalRegion("top", to_canonical)
    return SimpleNamespace(regions=(region,), parts={"part": (region,)}, base_canonical=ball((0, 0, 0), 0.5))


def test_what_lies_in_the_region_does_not_count(scene: Any, mi: object) -> None:
    base, inside = scene.base_canonical, ball((0, 0.6, 0), 0.2)
    assert surface_chamfer(both(base, inside), scene, 0.05) == pytest.approx(0, abs=1e-4)
    assert leaked_share(both(base, inside), scene, 0.05, 0.03) == 0
    beside = ball((0.8, 0, 0), 0.2)
    assert leaked_share(both(base, beside), scene, 0.05, 0.03) == 1
    half = leaked_share(both(both(base, inside), beside), scene, 0.05, 0.03)
    share_inside = (0.2**3 - 0.0) / (2 * 0.2**3)
    assert 1 - half == pytest.approx(share_inside, abs=0.2)
    # A ball that is 0.05 larger everywhere is 0.05 away, in both directions.
    assert surface_chamfer(ball((0, 0, 0), 0.55), scene, 0.05) == pytest.approx(0.05, rel=0.02)
    assert leaked_share(base, scene, 0.05, 0.03) is None
    # A root inside the base is hidden: only what sticks out is somewhere else.
    rooted = surface_chamfer(both(base, ball((0, -0.2, 0), 0.2)), scene, 0.05)
    assert rooted == pytest.approx(0, abs=1e-4)


def test_pixels_of_the_region_do_not_count(scene: Any, mi: object) -> None:
    outside = outside_regions(scene, RING, SIZE, 0.05)
    wanted = silhouettes(((0, 0.6, 0), 0.35)) == 0
    assert (outside != wanted).float().mean() < 0.01
    mask = silhouettes(BASE)
    base = EditedImages("normals", torch.zeros(8, 3, SIZE, SIZE), mask)
    values = torch.zeros(8, 3, SIZE, SIZE)
    values[~outside.expand_as(values)] = 1
    assert image_psnr(EditedImages("normals", values, mask), base, outside) == 200
    shifted = EditedImages("normals", torch.full((8, 3, SIZE, SIZE), 0.2) * mask, mask)
    assert image_psnr(shifted, base, outside) == pytest.approx(20, abs=0.01)  # a tenth in every counted pixel


def test_the_table_has_means_spreads_and_the_papers_numbers() -> None:
    results = [
        {"method": "fantasia3d", "clip": {"sim": sim, "dir_dot": 0.1}, "cost": {"seconds": 60.0, "guidance_calls": 400}}
        for sim in (0.2, 0.4)
    ]
    (row, empty) = compare_rows(results, ["fantasia3d", "pix2pix_2d"])
    cells = dict(zip(compare_header(), row, strict=True))
    assert cells["CLIP_sim ↑"] == "0.300 ± 0.141" and cells["paper CLIP_dir"] == "0.0180"
    assert cells["guidance calls"] == "400 ± 0" and cells["leakage ↓"] == "-" and cells["results"] == "2"
    assert empty[1:3] == ["-", "-"] and empty[-1] == "0"
