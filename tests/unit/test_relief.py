"""Features of a face or a flank that a maker of bodies does not give them, and which parts the wide prior sees most."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from fd_mitsuba.prior.data.catalogue import FINE, WIDE
from fd_mitsuba.prior.data.fine.bodies import BODIES
from fd_mitsuba.prior.data.fine.relief import with_relief
from fd_mitsuba.prior.data.parts import PARTS as PLAIN_PARTS
from fd_mitsuba.prior.pictures.fine_corpus import make_fine_pairs, make_wide_pairs


@pytest.mark.parametrize("name", ["person", "cow", "head", "teapot"])
def test_bumps_are_closed_grow_out_of_the_body_and_leave_its_anchors(name: str) -> None:
    plain = BODIES[name](np.random.default_rng(3))
    rough, again = (with_relief(plain, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(rough.solid.vertices, again.solid.vertices)
    assert np.array_equal(rough.solid.vertices[: len(plain.solid.vertices)], plain.solid.vertices)
    assert np.array_equal(rough.head_top, plain.head_top) and rough.head_radius == plain.head_radius
    added = rough.solid.faces[len(plain.solid.faces) :] - len(plain.solid.vertices)
    bumps = trimesh.Trimesh(rough.solid.vertices[len(plain.solid.vertices) :], added).split()
    assert len(bumps) > 2 and all(bump.is_watertight and bump.volume > 0 for bump in bumps)
    low, high = plain.solid.vertices.min(0), plain.solid.vertices.max(0)
    for bump in bumps:  # each has its middle on a body, so that none hangs free
        assert (bump.centroid > low - 0.05).all() and (bump.centroid < high + 0.05).all()
    assert np.ptp(rough.solid.vertices, axis=0).max() < 1.5 * (high - low).max()


def test_about_half_of_the_wide_priors_bodies_have_some(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr(
        "fd_mitsuba.prior.pictures.fine_corpus.with_relief", lambda body, rng: given.append(body) or body
    )
    for seed in range(40):
        make_wide_pairs("ball", [None], seed)
    assert 10 < len(given) < 30
    given.clear()
    for seed in range(10):
        make_fine_pairs("ball", [None], seed, 32)
    assert not given


def test_new_words_are_shown_more_often_than_what_another_prior_knows() -> None:
    new = [weight for part, weight in WIDE.part_weights.items() if part not in PLAIN_PARTS]
    old = [weight for part, weight in WIDE.part_weights.items() if part in PLAIN_PARTS and part != "glasses"]
    assert min(new) > max(old) and set(WIDE.part_weights) == set(FINE.part_weights)
