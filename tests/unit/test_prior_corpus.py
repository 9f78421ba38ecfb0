from __future__ import annotations

import numpy as np
import pytest
import torch

from fd_mitsuba.config import CamerasConfig
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.prior.data.bodies import BODIES
from fd_mitsuba.prior.data.parts import FEET, PARTS, resized
from fd_mitsuba.prior.data.primitives import Solid, box, join, transform
from fd_mitsuba.prior.pictures import corpus
from fd_mitsuba.prior.pictures.corpus import MosaicCamera, RayCaster, make_pairs, shade
from fd_mitsuba.scene.views import sample_views


def closed_volumes(solid: Solid) -> np.ndarray:
    """Signed volumes of the connected pieces; fails where an edge does not lie between two faces of one orientation."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces, count = solid.faces, len(solid.vertices)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    forward, backward = np.sort(start * count + end), np.sort(end * count + start)
    assert (np.diff(forward) > 0).all() and np.array_equal(forward, backward)
    piece = connected_components(coo_array((np.ones(len(start)), (start, end)), (count, count)), directed=False)[1]
    a, b, c = (solid.vertices[faces[:, k]] for k in range(3))
    return np.bincount(piece[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize("name", BODIES)
def test_bodies_and_parts_are_closed_and_face_outwards(name: str) -> None:
    for seed in range(2):
        random = np.random.default_rng(seed)
        body = BODIES[name](random)
        low, high = body.solid.vertices.min(0), body.solid.vertices.max(0)
        assert closed_volumes(body.solid).min() > 0
        assert (high - low).max() == pytest.approx(1.8) and np.abs(low + high).max() < 1e-9
        for part in PARTS.values():
            solid = part(body, random)
            assert np.isfinite(solid.vertices).all() and closed_volumes(solid).min() > 0


@pytest.mark.parametrize("name", BODIES)
def test_what_sits_on_the_spine_shows(name: str) -> None:
    """A ray that slipped through an edge of the body once left the spine, and what sits there, inside."""
    for seed in range(4):
        body = BODIES[name](np.random.default_rng(seed))
        points, outward = body.spine(5)
        distance, _ = RayCaster(body.solid).cast(points + 0.01 * outward, outward)
        assert not np.isfinite(distance).any() or body.upright  # a head may overhang an upright back
        assert all(pair.shows_part() for pair in make_pairs(name, ["backpack", "spikes"], seed))


def test_pairs_follow_from_the_seed() -> None:
    first, again, other = (make_pairs("duck", ["wings", None], seed) for seed in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.base, b.base) and np.array_equal(a.edited, b.edited) and a.caption == b.caption
    assert not np.array_equal(first[0].edited, other[0].edited)


def test_a_pair_differs_only_where_the_part_is() -> None:
    seed, name, part = 5, "mug", "handle"
    overview, closeup, nothing = make_pairs(name, [part, None], seed)
    assert np.array_equal(nothing.base, nothing.edited) and nothing.part is None
    random = np.random.default_rng([seed, list(BODIES).index(name)])
    body, stretch = BODIES[name](random), corpus.random_stretch(random)
    camera = corpus.global_camera(random)
    assert camera.azimuth_deg == overview.azimuth_deg
    origins, directions, rotations = camera.rays()
    solid = transform(resized(part, PARTS[part](body, random), body, random), stretch)
    seen = shade(*RayCaster(solid).cast(origins, directions), rotations)[3] > -127
    changed = (overview.base != overview.edited).any(0)
    assert changed.sum() > 20 and not (changed & ~seen).any()
    assert closeup.closeup and (closeup.base != closeup.edited).any(0).sum() > changed.sum()
    for pair in (overview, closeup, nothing):
        for latent in (pair.base, pair.edited):
            assert latent.shape == (4, 64, 64) and latent.dtype == np.int8 and latent.min() >= -127
            length = np.linalg.norm(latent[:3].astype(float) / 127, axis=0)
            coverage = (latent[3].astype(float) / 127 + 1) / 2
            assert (length <= coverage + 0.02).all()
        assert (pair.edited[3].astype(int) >= pair.base[3]).all()


@pytest.fixture(scope="module")
def lopsided() -> Solid:
    """A body that no mirror and no turn maps to itself: a handle on +x, a box in front and high, another one behind."""
    random = np.random.default_rng(0)
    mug = BODIES["mug"](random)
    extra = [box((0.1, 0.6, 0.75), (0.12, 0.2, 0.1)), box((-0.5, -0.6, -0.5), (0.2, 0.1, 0.3))]
    return join([mug.solid, PARTS["handle"](mug, random), *extra])


@pytest.mark.parametrize("seed", range(3))
def test_training_mosaics_look_like_those_of_a_run(mi: object, lopsided: Solid, seed: int) -> None:
    """Same frame, signs, order of views and place in the mosaic: the prior is of no use if any of them differs."""
    from fd_mitsuba.render.geometry_pass import GeometryPass

    views = sample_views(CamerasConfig(centre_jitter=0.1), 4, seed, together=4)
    assert views.azimuth_deg[0] < 90
    vertices, faces = torch.from_numpy(lopsided.vertices).float(), torch.from_numpy(lopsided.faces)
    pictures = GeometryPass(corpus.VIEW_SIZE).render_primal(
        vertices, faces, torch.zeros(len(vertices)), views, seed, spp=64
    )
    run = tile_views(torch.cat([pictures[:, :3], 2 * pictures[:, 3:4] - 1], dim=1), 2)[0].numpy()

    angles = (float(values[0]) for values in (views.azimuth_deg, views.elevation_deg, views.fov_deg))
    camera = MosaicCamera(*angles, target=views.target[0].astype(np.float64))
    origins, directions, rotations = camera.rays()
    training = shade(*RayCaster(lopsided).cast(origins, directions), rotations) / 127

    difference = np.abs(run - training)
    inside = (run[3] > 0.999) & (training[3] > 0.999)
    assert inside.sum() > 500
    assert difference.mean() < 0.02 and np.quantile(difference[:3, inside], 0.95) < 0.05
    # What a mistake would look like: any of these is several times as far away.
    mirrored = [training[:, :, ::-1], training[:, ::-1], np.roll(training, 32, axis=2), training.transpose(0, 2, 1)]
    signs = [training * np.array(sign)[:, None, None] for sign in ((-1, 1, 1, 1), (1, -1, 1, 1), (1, 1, -1, 1))]
    for wrong in mirrored + signs:
        assert np.abs(run - wrong).mean() > 3 * difference.mean()


def test_top_left_view_is_the_first_and_the_next_ones_turn_towards_plus_x(lopsided: Solid) -> None:
    """A camera at azimuth 90 stands on +x: what sticks out there faces it, in the tile on the top right."""
    marker = join([box((0.8, 0, 0), (0.1, 0.3, 0.3))])
    origins, directions, rotations = MosaicCamera(0.0, 0.0, 40.0, np.zeros(3)).rays()
    latent = shade(*RayCaster(marker).cast(origins, directions), rotations) / 127
    front, right, back, left = latent[:, :32, :32], latent[:, :32, 32:], latent[:, 32:, :32], latent[:, 32:, 32:]
    columns = np.arange(32)[None]
    centre = [float((columns * (tile[3] + 1)).sum() / (tile[3] + 1).sum()) for tile in (front, right, back, left)]
    assert centre[0] > 18 and centre[2] < 13 and abs(centre[1] - 15.5) < 0.5 and abs(centre[3] - 15.5) < 0.5
    assert (right[3] > 0).sum() > (left[3] > 0).sum()  # nearer, so larger
    assert right[2, 16, 16] > 0.95  # it faces the viewer


@pytest.mark.parametrize("part", PARTS)
def test_resizing_keeps_a_parts_shape_and_where_it_sits(part: str) -> None:
    random = np.random.default_rng(4)
    body = BODIES["dog"](random)
    before = PARTS[part](body, random)
    after = resized(part, before, body, random)
    if part not in FEET:
        assert after is before
        return
    foot = FEET[part](body)
    size = np.linalg.norm(after.vertices - foot, axis=1) / np.linalg.norm(before.vertices - foot, axis=1)
    assert np.ptp(size) < 1e-9 and 0.65 <= size[0] <= 1.2
    edges = [np.linalg.norm(s.vertices[s.faces[:, 0]] - s.vertices[s.faces[:, 1]], axis=1) for s in (before, after)]
    assert np.allclose(edges[1], edges[0] * size[0])
