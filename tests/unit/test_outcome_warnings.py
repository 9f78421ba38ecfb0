"""What the end of a run warns of, by its metrics."""

from __future__ import annotations

import pytest

from fd_mitsuba.runs.outcome_warnings import outcome_warnings

GOOD = {"inside_fraction": 0.99, "overlap_fraction": 0.01, "gap": 0.0, "islands_removed": 0, "manifold": True}


def test_nothing_is_said_of_a_good_part() -> None:
    assert outcome_warnings(GOOD) == [] and outcome_warnings({}) == []


@pytest.mark.parametrize(
    "fault, named",
    [
        ({"inside_fraction": 0.495}, ("49.5 %", "focal regions", "seed=1")),
        ({"overlap_fraction": 0.8}, ("80 %", "inside the base")),
        ({"gap": 0.276}, ("0.276", "away from the base")),
        ({"islands_removed": 2}, ("2 loose pieces",)),
        ({"islands_removed": 1}, ("a loose piece",)),
        ({"loose_pieces": 2}, ("2 pieces of the base hang free", "hold all that is to go")),
        ({"manifold": False}, ("manifold",)),
    ],
)
def test_each_fault_is_one_line_with_a_remedy(fault: dict, named: tuple[str, ...]) -> None:
    (line,) = outcome_warnings(GOOD | fault)
    assert all(text.replace(" %", "%") in line or text in line for text in named)
    assert ":" in line and "\n" not in line


def test_a_cut_may_lie_in_the_base_and_hang_on_nothing() -> None:
    end = {"part": "part", "gap": 0.3, "position": [0.0, 0.0, 0.0]}
    cut = GOOD | {"removed_volume": 3.0, "overlap_fraction": 0.8, "gap": 0.2, "islands_removed": 1, "free_ends": [end]}
    assert outcome_warnings(cut) == []
    (line,) = outcome_warnings(cut | {"inside_fraction": 0.5})
    assert "focal regions" in line
