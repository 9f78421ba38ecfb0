"""What training tells of where a part may be, against a sphere's own outline and the part that it is drawn around."""

from __future__ import annotations

import numpy as np
import pytest

from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.parts import PARTS
from fd_mitsuba.prior.data.primitives import Solid, box, ellipsoid, rotation
from fd_mitsuba.prior.pictures.corpus import (
    CAMERA_RADIUS,
    SUPERSAMPLING,
    VIEW_SIZE,
    MosaicCamera,
    RayCaster,
    make_pairs,
)
from fd_mitsuba.prior.pictures.fine_corpus import make_wide_pairs
from fd_mitsuba.prior.pictures.region_picture import Ellipsoid, region_picture, regions_around


def picture_of(regions: list[Ellipsoid], camera: MosaicCamera) -> np.ndarray:
    return region_picture(regions, *camera.rays()[:2], VIEW_SIZE, SUPERSAMPLING) / 127


def test_a_sphere_covers_the_disc_that_its_angle_says() -> None:
    radius, fov = 0.4, 30.0
    camera = MosaicCamera(20.0, 15.0, fov, np.zeros(3))
    share = picture_of([Ellipsoid(np.zeros(3), radius * np.eye(3))], camera).mean()
    seen = np.tan(np.arcsin(radius / CAMERA_RADIUS)) / np.tan(np.deg2rad(fov / 2))
    assert share == pytest.approx(np.pi / 4 * seen**2, rel=0.03)
    assert picture_of([], camera).max() == 0


def test_an_ellipsoid_is_met_where_its_mesh_is() -> None:
    random = np.random.default_rng(0)
    for _ in range(5):
        half, turned, centre = (
            random.uniform(0.1, 0.5, 3),
            rotation(*random.uniform(0, 360, 3)),
            random.normal(0, 0.2, 3),
        )
        rays = MosaicCamera(random.uniform(0, 90), 20.0, 40.0, np.zeros(3)).rays()
        met = Ellipsoid(centre, turned * half).hit_by(*rays[:2])
        mesh = RayCaster(ellipsoid(centre, half, turned))
        assert (met == np.isfinite(mesh.cast(*rays[:2])[0])).mean() > 0.985  # the mesh has corners


@pytest.mark.parametrize("make", [make_pairs, make_wide_pairs])
def test_it_is_where_the_part_is_and_not_always_told(make) -> None:
    told, within = [], []
    for seed in range(12):
        for pair in make("cat", ["crown", "wings", "tail", None], seed):
            assert pair.region.shape == pair.base.shape[1:] and pair.region.dtype == np.int8
            assert np.array_equal(pair.seen(), np.concatenate([pair.region[None], pair.base]))
            told.append(pair.region.max() > 0)
            if pair.part and told[-1]:
                within.append((pair.region > 0)[pair.changed()].mean())
    assert 0.8 < np.mean(told) < 0.98
    assert np.mean(within) > 0.75 and np.quantile(within, 0.05) > 0.35


def test_halves_are_drawn_apart_and_sizes_differ() -> None:
    body = BODIES["horse"](np.random.default_rng(1))
    wings = PARTS["wings"](body, np.random.default_rng(1))
    found = [regions_around(wings, np.random.default_rng(seed)) for seed in range(40)]
    assert {len(regions) for regions in found} == {1, 2}
    for first, second in (regions for regions in found if len(regions) == 2):
        assert first.centre[0] * second.centre[0] < 0
    sizes = [np.linalg.svd(regions[0].linear, compute_uv=False)[0] for regions in found if len(regions) == 1]
    assert max(sizes) > 1.3 * min(sizes)


def test_a_sheet_gets_a_region_with_a_thickness() -> None:
    sheet: Solid = box((0, 0, 0), (0.5, 0.001, 0.5))
    for seed in range(10):
        (region,) = regions_around(sheet, np.random.default_rng(seed))[:1]
        assert np.linalg.svd(region.linear, compute_uv=False)[-1] >= 0.06 - 1e-9
