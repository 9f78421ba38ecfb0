"""Guidance by the randomly initialised pipelines of `tiny_pipelines`, each folder read once."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance import loading
from fd_mitsuba.guidance.diffusion import DiffusionGuidance


@cache
def components_of(folder: Path, dtype: str = "float32") -> loading.Components:
    """The networks of a folder that `save_pipeline` wrote."""
    return loading.load_components(GuidanceConfig(model=str(folder), dtype=dtype))


def load(folder: Path, appearance: AppearanceConfig | None = None, **settings: object) -> DiffusionGuidance:
    """The guidance of such a folder, with a prompt and a negative prompt.

    Args:
        settings: of `[guidance]`.
    """
    config = GuidanceConfig(model=str(folder), **settings)
    guidance = DiffusionGuidance(components_of(folder, config.dtype), config, appearance=appearance)
    guidance.set_prompt("a horse with wings", "blurry")
    return guidance
