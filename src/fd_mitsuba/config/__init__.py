"""How to edit: frozen, strict settings (`RunConfig`), read by `load_config` and dumped beside every run."""

from fd_mitsuba.config.loading import load_config
from fd_mitsuba.config.run_config import RunConfig
from fd_mitsuba.config.sections import (
    AppearanceConfig,
    CamerasConfig,
    FieldConfig,
    GeometryConfig,
    GuidanceConfig,
    OutputConfig,
    Section,
    TextureConfig,
)

__all__ = [
    "AppearanceConfig",
    "CamerasConfig",
    "FieldConfig",
    "GeometryConfig",
    "GuidanceConfig",
    "OutputConfig",
    "RunConfig",
    "Section",
    "TextureConfig",
    "load_config",
]
