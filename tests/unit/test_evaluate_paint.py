"""Counting for the prior of colours."""

from __future__ import annotations

from fd_mitsuba.prior.judging.evaluate_paint import nearest_shares, painted_figures
from fd_mitsuba.prior.judging.paint_check import Painted


def painted(nearest: str, metallic: float, roughness: float = 0.6) -> Painted:
    return Painted((0.5, 0.5, 0.5), nearest, (0.5, 0.5, 0.5), roughness, metallic, 1.0, [])


def test_shares_of_colours_and_materials() -> None:
    shares = nearest_shares([("red", "red"), ("blue", "purple"), ("gold", "gold")])
    assert shares == {"prompts": 3, "all": 0.6667, "colours": 0.5, "materials": 1.0, "bar": 0.85}
    assert nearest_shares([])["all"] is None


def test_metals_must_become_metallic_and_others_not() -> None:
    done = [
        (("cat", "crown", "gold"), painted("gold", 0.8, 0.2)),
        (("cat", "horn", "gold"), painted("yellow", 0.4)),
        (("cat", "horn", "silver"), painted("silver", 0.2)),
        (("cat", "horn", "wood"), painted("wood", 0.1)),
        (("cat", "horn", "red"), painted("red", 0.9)),
    ]
    figures = painted_figures(done)
    assert figures["metallic"] == {"gold": 0.6, "silver": 0.2, "wood": 0.1} and figures["all"] == 0.8
    assert figures["metallic_right"] == {"gold": True, "silver": False, "wood": True}
    assert figures["roughness"] == {"gold": 0.4, "silver": 0.6, "wood": 0.6}
    assert figures["roughness_right"] == {"gold": True, "silver": False, "wood": True}
