"""Seeds: a function of run, purpose and step alone, and no two alike."""

from __future__ import annotations

from fd_mitsuba.training.seeds import Purpose, seed_for


def test_fixed_for_ever() -> None:
    # A resumed run must draw the same numbers with every later version, so the values themselves are promised.
    assert [int(purpose) for purpose in Purpose] == list(range(len(Purpose)))
    assert (seed_for(0, Purpose.FIELD), seed_for(7, Purpose.GUIDANCE, 123)) == (1484405855, 671366485)


def test_all_different_and_in_range() -> None:
    seeds = [seed_for(run, purpose, step) for run in range(3) for purpose in Purpose for step in range(500)]
    assert len(set(seeds)) >= len(seeds) - 1  # by chance two of 9000 among 2^31 agree in 2 % of such lists
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_bits_are_balanced() -> None:
    seeds = [seed_for(0, Purpose.VIEWS, step) for step in range(2000)]
    shares = [sum(seed >> bit & 1 for seed in seeds) / len(seeds) for bit in range(31)]
    assert all(0.44 < share < 0.56 for share in shares)
