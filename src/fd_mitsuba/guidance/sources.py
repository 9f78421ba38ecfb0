"""The entries of `guidance.kind`: what guides a run, by name. Any object with the methods of `interface` will do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.registry import NoSettings, Registry
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.interface import Guidance

GUIDANCES: Registry[Callable[[Any, RunConfig], Guidance]] = Registry("guidances", "guidance")
"""Called with their settings and the run's. One that has `guide_appearance` too serves the appearance stage as well;
beside one that has not, that stage is guided by `guidance.model`."""


@GUIDANCES.register("diffusion")
def diffusion(settings: NoSettings, config: RunConfig) -> DiffusionGuidance:
    """The model that `guidance.model` names, with the other settings of the section."""
    return DiffusionGuidance.load(config.guidance)


def load_guidance(config: RunConfig) -> Guidance:
    """What `guidance.kind` names; UserError where its settings or its files are wrong."""
    return GUIDANCES.make(config.guidance.kind, "guidance.kind", config)
