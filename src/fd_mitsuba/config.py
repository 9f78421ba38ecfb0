"""How to edit: frozen, strict settings read from TOML, overridden by `--set`, dumped beside every run."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from fd_mitsuba.errors import UserError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
Range = tuple[float, float]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class FieldConfig(_Section):
    """The editable part's network: a hash grid and a two-layer MLP (paper, supplement "Geometry Learning")."""

    levels: Count = 10
    features: Count = 2
    base_resolution: Count = 8
    finest_resolution: Count = 128
    log2_table: Annotated[int, Field(ge=4, le=24)] = 15
    hidden: Count = 32
    offsets: bool = True
    """Let vertices of the tetrahedral grid move by up to half a cell, where the base's surface is not touched."""


class GeometryConfig(_Section):
    steps: Count = 3000
    coarse_fraction: Fraction = 2 / 3
    """Share of the steps in the coarse phase; the rest is the refined phase."""
    learning_rate: Positive = 1e-3
    betas: Range = (0.9, 0.99)
    eps: Positive = 1e-15
    weight_decay: NonNegative = 0.01
    grid_resolution: Annotated[int, Field(ge=8, le=256)] = 64
    """Cells a side of the tetrahedral grid: 64 has 275k vertices, 128 has 2.1M."""
    union_k: NonNegative = 0.15
    union_only_outside: bool = False
    lambda_sds: NonNegative = 1.0
    lambda_focal: NonNegative = 1000.0
    focal_sigma_distance: Positive = 0.05
    focal_sigma_sdf: Positive = 0.01
    focal_margin: NonNegative = 0.0
    """The paper's xi: also punishes an SDF that is negative by less than this."""
    focal_band: NonNegative = 0.05
    """Distance around the focal region, in canonical units, in which the part may overrun for free."""
    focal_samples: Count = 10240
    lambda_collision: NonNegative = 100.0
    lambda_volume: NonNegative = 0.0
    views: Count = 4
    spp: Count = 4
    silhouette_spp: Count = 1
    normal_space: Literal["camera", "world"] = "camera"


class GuidanceConfig(_Section):
    model: str = "builtin"
    """`builtin`, a folder in Stable-Diffusion layout, or a hub id."""
    variant: Literal["sds", "csd", "reconstruction"] = "sds"
    guidance_scale: NonNegative = 100.0
    """Written as diffusers does: uncond + w (text - uncond)."""
    image_guidance_scale: NonNegative = 1.0
    weighting: Literal["sds", "uniform", "fantasia3d", "inverse"] = "sds"
    timestep_range_coarse: Range = (0.02, 0.35)
    timestep_range_refined: Range = (0.02, 0.35)
    timestep_anneal: Fraction = 0.0
    """Share of the range by which the upper end has come down at the last step of a phase; 0 keeps it."""
    normalise_gradient: bool = False
    views_per_call: Count = 4
    """Pictures sent through the UNet at once; fewer need less memory."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    view_prompts: bool = True


class CamerasConfig(_Section):
    radius: Positive = 3.0
    elevation_deg: Range = (-10.0, 45.0)
    fov_deg: Range = (38.0, 45.0)
    centre_jitter: NonNegative = 0.0
    aim: Literal["origin", "object"] = "origin"
    """What the cameras look at: the base's centre, or the centre of base and focal regions together."""
    focus_fraction: Fraction = 0.0
    """Share of the steps whose views are centred on the focal regions and close."""


class OutputConfig(_Section):
    sheet_every: Annotated[int, Field(ge=0)] = 250
    checkpoint_every: Count = 100
    checkpoints_kept: Count = 2
    turntable_frames: Count = 48
    turntable_size: Annotated[int, Field(ge=16)] = 256


class RunConfig(_Section):
    """Everything that decides a run besides the scene."""

    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    field: FieldConfig = FieldConfig()
    geometry: GeometryConfig = GeometryConfig()
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

    def content_hash(self) -> str:
        """Sixteen hex digits that change with any setting."""
        return hashlib.sha256(json.dumps(self.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()[:16]


def load_config(path: Path | str | None, overrides: list[str] | tuple[str, ...] = ()) -> RunConfig:
    """The settings of a TOML file (None: the defaults, which are the paper's) after `section.key=value` overrides.

    Values of overrides are read as TOML, and as plain text where they are not TOML.

    Raises:
        UserError: unreadable file, unknown section or key, value of the wrong type or out of range.
    """
    source = "--set" if path is None else str(path)
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise UserError(f"{path}: no such config file; give a path such as configs/quick.toml") from None
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{path}: cannot be read ({error}); give a readable TOML file") from None
        except tomllib.TOMLDecodeError as error:
            raise UserError(f"{path}: not valid TOML ({error}); mend that line") from None
    for item in overrides:
        _apply_override(data, item)
    try:
        return RunConfig.model_validate(data)
    except ValidationError as error:
        raise UserError(f"{source}: {_first_problem(error)}") from None


def _apply_override(data: dict[str, Any], item: str) -> None:
    key, separator, text = item.partition("=")
    if not separator or not key:
        raise UserError(f"--set {item}: write section.key=value, as in --set geometry.steps=200")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *sections, name = key.split(".")
    target = data
    for section in sections:
        target = target.setdefault(section, {})
        if not isinstance(target, dict):
            raise UserError(f"--set {item}: {section!r} is a value, not a section")
    target[name] = value


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        known = _known_keys()
        near = difflib.get_close_matches(key, known, n=3, cutoff=0.4)
        hint = f"nearest: {', '.join(near)}" if near else f"sections: {', '.join(RunConfig.model_fields)}"
        return f"unknown key {key!r}; {hint}"
    return f"{key + ': ' if key else ''}{problem['msg']} (given: {str(problem['input'])[:60]!r}); change the value"


def _known_keys() -> list[str]:
    keys = []
    for name, info in RunConfig.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            keys += [f"{name}.{inner}" for inner in info.annotation.model_fields]
        else:
            keys.append(name)
    return keys
