"""How to edit: everything that decides a run besides the scene, and which of it decides the result."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from fd_mitsuba.config.guidance_section import GuidanceConfig
from fd_mitsuba.config.identity import MAY_CHANGE, identity_settings
from fd_mitsuba.config.section import Section
from fd_mitsuba.config.sections import (
    AppearanceConfig,
    CamerasConfig,
    FieldConfig,
    GeometryConfig,
    OutputConfig,
    TextureConfig,
)
from fd_mitsuba.config.toml_reading import apply_override, first_problem, guilty_override, read_toml, shortened
from fd_mitsuba.conventions import STAGES
from fd_mitsuba.errors import UserError

_CHOICES = ("kind", "variant")
"""The settings of `guidance` that name an entry of a registry."""
_NEWER = {
    "geometry.lambda_tether": 0.0,
    "geometry.start_variety": 0.0,
    "geometry.lambda_curvature": 0.0,
    "geometry.fade": 0.0,
    "geometry.draft_fraction": 0.0,
    "guidance.timestep_range_drafted": [0.02, 0.6],
    "guidance.perp_neg": 0.0,
    "guidance.mask_margin": 2,
    "guidance.lora": [],
    "guidance.lora_scale": 1.0,
    "guidance.words": [],
    "guidance.image_prompt": "",
    "guidance.ip_adapter": "",
    "guidance.ip_adapter_encoder": "",
    "guidance.image_prompt_scale": 1.0,
    "guidance.controlnet": "",
    "guidance.controlnet_scale": 1.0,
    "guidance.controlnet_sees": "depth",
    "guidance.mask_channel": "auto",
    "guidance.normal_augmentation": "none",
    "guidance.refined_background": "black",
    "guidance.reduction": "mean",
    "appearance.soft_mask": False,
    "appearance.fade": 0.0,
}
"""Settings that came after the first runs, at the value that does nothing: so those runs can still be read."""


class RunConfig(Section):
    """Everything that decides a run besides the scene."""

    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    """All random numbers of a run follow from it."""
    plugins: Annotated[tuple[str, ...], MAY_CHANGE] = ()
    """Modules, or .py files, that are imported before a run, so that they register what the settings name."""
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
            ("guidance", "timestep_range_drafted", 0, 1),
            ("guidance", "timestep_range_refined", 0, 1),
            ("cameras", "elevation_deg", -90, 90),
            ("cameras", "fov_deg", 1, 150),
            ("geometry", "betas", 0, 1),
        ):
            first, last = getattr(getattr(self, section), name)
            if not (low <= first <= high and low <= last <= high and first <= last) or (name == "betas" and last >= 1):
                raise ValueError(f"{section}.{name} = ({first}, {last}) must be ordered and lie in [{low}, {high}]")
        return self

    @classmethod
    def load(cls, source: Path | str | Mapping[str, Any] | None = None, overrides: Sequence[str] = ()) -> RunConfig:
        """Settings after `section.key=value` overrides, whose values are TOML, or text where they are not TOML.

        Args:
            source: a TOML file, the name of shipped settings (`quick`, `paper`, `smoke`), a dict of the same form, or
                None for the defaults, which are the paper's. `settings_for_run` chooses by the guidance model.

        Raises:
            UserError: unreadable file, unknown section or key, value of the wrong type or out of range.

        Example:
            RunConfig.load("quick", ["geometry.steps=200", "seed=3"])
        """
        if source is None or isinstance(source, Mapping):
            data: dict[str, Any] = copy.deepcopy(dict(source or {}))
        else:
            data = read_toml(source)
        items = {apply_override(data, item): item for item in overrides}
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            item = guilty_override(error, items)
            named = "--set" if source is None else "settings" if isinstance(source, Mapping) else source
            place = f"--set {shortened(item)}" if item is not None else named
            raise UserError(f"{place}: {first_problem(error, cls)}") from None

    def identity(self, stage: str = "geometry") -> dict[str, Any]:
        """`section.key` -> value of what the stage depends on: its own settings and those of the stages before it.

        Those marked with `MAY_CHANGE` are not among them.
        """
        later = frozenset({"texture", "appearance"}) if stage == "geometry" else frozenset()
        values = identity_settings(self, later)
        return {key: value for key, value in values.items() if _NEWER.get(key, ...) != value}

    def content_hash(self, stage: str = "geometry") -> str:
        """Sixteen hex digits that change with any setting in `identity`."""
        text = json.dumps(self.identity(stage), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def names_entries(self) -> bool:
        """Whether anything is named besides the defaults, which only the registries can check."""
        usual = GuidanceConfig()
        named = any(getattr(self.guidance, name) != getattr(usual, name) for name in _CHOICES)
        return named or bool(self.geometry.losses or self.appearance.losses)

    def completed_by(self, other: RunConfig) -> RunConfig:
        """These settings with the options that `other`'s choices of the same names have besides."""
        guidance = {name: getattr(self.guidance, name).completed_by(getattr(other.guidance, name)) for name in _CHOICES}
        changed: dict[str, Any] = {"guidance": self.guidance.model_copy(update=guidance)}
        for stage in STAGES:
            section, theirs = getattr(self, stage), getattr(other, stage).losses
            losses = {
                name: loss.with_options(loss.choice(name).completed_by(theirs[name].choice(name)).options)
                if name in theirs
                else loss
                for name, loss in section.losses.items()
            }
            changed[stage] = section.model_copy(update={"losses": losses})
        return self.model_copy(update=changed)
