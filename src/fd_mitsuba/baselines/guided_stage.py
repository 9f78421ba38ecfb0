"""What the stages of other methods share with our own: guidance, cameras, steps and phases are those of its stage."""

from __future__ import annotations

from fd_mitsuba.guidance.interface import Guidance
from fd_mitsuba.training.geometry_stage import GeometryStage
from fd_mitsuba.training.weight_average import WeightAverage


class GuidedStage:
    """Base of a method's stage.

    Args:
        own: our own method's stage of the same scene and settings, with its guidance: gives cameras, base, guidance.
    """

    name = "geometry"
    average: WeightAverage | None = None

    def __init__(self, own: GeometryStage) -> None:
        self.own, self.config = own, own.config
        self.counters: dict[str, int] = {}

    @property
    def guidance(self) -> Guidance | None:
        """Our own method's; what it has learned is kept with checkpoints."""
        return self.own.guidance

    @property
    def steps(self) -> int:
        """As many as our own method's geometry stage has."""
        return self.own.steps

    def phase_name(self, step: int) -> str:
        """`coarse` or `refined`, as in our own method."""
        return self.own.phase_name(step)
