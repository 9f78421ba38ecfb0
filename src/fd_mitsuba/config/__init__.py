"""How to edit: frozen, strict settings (`RunConfig`) from TOML, by the guidance model, kept beside each run."""

from fd_mitsuba.config.for_model import ChosenSettings, misfits, settings_for_run
from fd_mitsuba.config.guidance_section import GuidanceConfig
from fd_mitsuba.config.run_config import RunConfig
from fd_mitsuba.config.section import Section
from fd_mitsuba.config.sections import (
    AppearanceConfig,
    CamerasConfig,
    FieldConfig,
    GeometryConfig,
    OutputConfig,
    TextureConfig,
)

__all__ = [
    "AppearanceConfig",
    "CamerasConfig",
    "ChosenSettings",
    "FieldConfig",
    "GeometryConfig",
    "GuidanceConfig",
    "OutputConfig",
    "RunConfig",
    "Section",
    "TextureConfig",
    "misfits",
    "settings_for_run",
]
