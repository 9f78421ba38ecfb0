"""How to edit: everything that decides a run besides the scene, and which of it decides the result."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated

from pydantic import Field, model_validator

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

_WITHOUT_EFFECT = {"guidance": ("device",)}
"""Settings that change where the work is done and not what comes out."""
_NEWER = {"geometry": {"lambda_tether": 0.0}}
"""Settings that came after the first runs, at the value that does nothing: so those runs can still be read."""


class RunConfig(Section):
    """Everything that decides a run besides the scene."""

    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    field: FieldConfig = FieldConfig()
    geometry: GeometryConfig = GeometryConfig()
    texture: TextureConfig = TextureConfig()
    appearance: AppearanceConfig = AppearanceConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    cameras: CamerasConfig = CamerasConfig()
    output: OutputConfig = OutputConfig()

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> RunConfig:
        for section, name, low, high in (
            ("guidance", "timestep_range_coarse", 0, 1),
            ("guidance", "timestep_range_refined", 0, 1),
            ("cameras", "elevation_deg", -90, 90),
            ("cameras", "fov_deg", 1, 150),
            ("geometry", "betas", 0, 1),
        ):
            first, last = getattr(getattr(self, section), name)
            if not (low <= first <= high and low <= last <= high and first <= last) or (name == "betas" and last >= 1):
                raise ValueError(f"{section}.{name} = ({first}, {last}) must be ordered and lie in [{low}, {high}]")
        return self

    def content_hash(self, stage: str = "geometry") -> str:
        """Sixteen hex digits that change with any setting that the stage depends on, its own and those before it."""
        later = {"texture", "appearance"} if stage == "geometry" else set()
        values = self.model_dump(mode="json", exclude=later)
        for section, names in _WITHOUT_EFFECT.items():
            for name in names:
                del values[section][name]
        for section, neutral in _NEWER.items():
            for name, value in neutral.items():
                if values[section][name] == value:
                    del values[section][name]
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]
