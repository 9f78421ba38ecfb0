"""The sections of a run's settings: one frozen, strict model each. `config` puts them together and reads them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from fd_mitsuba.config.choice import Choice, Weighted
from fd_mitsuba.conventions import TextureChannel

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
Range = tuple[float, float]


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class FieldConfig(Section):
    """The editable part's network: a hash grid and a two-layer MLP (paper, supplement "Geometry Learning")."""

    levels: Count = 10
    features: Count = 2
    base_resolution: Count = 8
    finest_resolution: Count = 128
    log2_table: Annotated[int, Field(ge=4, le=24)] = 15
    hidden: Count = 32
    offsets: bool = True
    """Let vertices of the tetrahedral grid move by up to half a cell, where the base's surface is not touched."""


class GeometryConfig(Section):
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
    lambda_presence: NonNegative = 0.0
    """Weight of the loss that leaves no focal region without a part; not in the paper."""
    presence_share: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Share of each region, outside the base, that it keeps filled."""
    lambda_tether: NonNegative = 0.0
    """Weight of the loss that keeps pieces of the part from coming loose from the base; not in the paper."""
    losses: dict[str, Weighted] = {}
    """Losses of other modules by name, each with its `lambda` and its own settings; see docs/extending.md."""
    views: Count = 4
    spp: Count = 4
    silhouette_spp: Count = 1
    normal_space: Literal["camera", "world"] = "camera"


class TextureConfig(Section):
    """The part's texture field: a hash grid and an MLP with one hidden layer (supplement "PBR Material")."""

    levels: Count = 12
    features: Count = 2
    base_resolution: Count = 16
    finest_resolution: Count = 1024
    log2_table: Annotated[int, Field(ge=4, le=24)] = 16
    hidden: Count = 32
    base_color_range: Range = (0.03, 0.94)
    """Above 0.94 a `principled` returns more light than it gets, since its highlight comes on top of the rest."""
    roughness_range: Range = (0.08, 1.0)
    metallic_range: Range = (0.0, 1.0)
    max_tilt_deg: Annotated[float, Field(ge=0, lt=90)] = 30.0
    """How far the field may bend a shading normal."""

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> TextureConfig:
        for name in ("base_color_range", "roughness_range", "metallic_range"):
            low, high = getattr(self, name)
            if not 0 <= low <= high <= 1:
                raise ValueError(f"{name} = ({low}, {high}) must be ordered and lie in [0, 1]")
        if self.finest_resolution < self.base_resolution:
            raise ValueError("finest_resolution must not be below base_resolution")
        return self


class AppearanceConfig(Section):
    steps: Count = 2000
    learning_rate: Positive = 1e-2
    betas: Range = (0.9, 0.99)
    eps: Positive = 1e-15
    weight_decay: NonNegative = 0.01
    views: Count = 4
    picture_size: Annotated[int, Field(ge=16, le=4096)] | None = None
    """Side of a rendered view in pixels; none: what the guidance model works with."""
    spp: Count = 16
    max_depth: Annotated[int, Field(ge=-1)] = 2
    """As Mitsuba's `path`: 2 is direct light with shadows, more adds bounces, -1 does not end them."""
    exposure: Positive | None = None
    """Factor on linear colour before the sRGB curve; none: chosen once from the base as it is lit."""
    background: Literal["black", "white", "random", "light"] = "white"
    normal_map: bool = True
    fixed: tuple[TextureChannel, ...] = ()
    """Channels that keep the values of the scene's part BSDF."""
    timestep_range: Range = (0.02, 0.98)
    weighting: Literal["sds", "uniform", "fantasia3d", "inverse"] = "inverse"
    guidance_scale: NonNegative = 100.0
    image_guidance_scale: NonNegative = 1.0
    mask_guidance: bool = True
    """Noise and gradient only where the part is seen."""
    lambda_sds: NonNegative = 1.0
    style: bool = False
    """Style consistency with the base, for parts that continue its material; most edits do without."""
    lambda_style: NonNegative = 10.0
    lambda_boundary: NonNegative = 100.0
    style_samples: Count = 2048
    style_jitter: Positive = 0.01
    """Standard deviation of the paper's delta, canonical units."""
    boundary_reach: Positive = 0.03
    """The part's boundary is its surface within this distance of the base, canonical units."""
    lambda_bend: NonNegative = 0.0
    """Price on bends of the shading normal, so that they are detail and not a lean of the whole part to the light."""
    losses: dict[str, Weighted] = {}
    """As `geometry.losses`, on the texture field."""
    single_path: bool = False
    """The paper's ablation: one field for the whole object, the base included."""

    @model_validator(mode="after")
    def _values_make_sense(self) -> AppearanceConfig:
        for name in ("timestep_range", "betas"):
            first, last = getattr(self, name)
            if not 0 <= first <= last <= 1 or (name == "betas" and last == 1):
                raise ValueError(f"{name} = ({first}, {last}) must be ordered and lie in [0, 1]")
        if self.max_depth in (0, 1):
            raise ValueError(f"max_depth = {self.max_depth} renders no light; use 2 or more, or -1")
        return self


class GuidanceConfig(Section):
    kind: Choice = Choice(kind="diffusion")
    """What guides: the diffusion model of the keys below, or a guidance of another module with its own settings."""
    model: str = "builtin"
    """`builtin`, a folder in Stable-Diffusion layout, or a hub id."""
    variant: Choice = Choice(kind="sds")
    """What makes the gradient: `sds`, `csd`, `ism`, `reconstruction`; `guidance.variants` has formulas and settings."""
    guidance_scale: NonNegative = 100.0
    """Written as diffusers does: uncond + w (text - uncond)."""
    image_guidance_scale: NonNegative = 1.0
    weighting: Literal["sds", "uniform", "fantasia3d", "inverse"] = "sds"
    timestep_range_coarse: Range = (0.02, 0.35)
    timestep_range_refined: Range = (0.02, 0.35)
    timestep_annealing: Literal["none", "linear", "sqrt"] = "none"
    """`none` draws t; the others go through the range from its upper to its lower end, once a phase."""
    normalise_gradient: bool = False
    views_per_call: Count = 4
    """Pictures sent through the UNet at once; fewer need less memory."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    device: Annotated[str, Field(pattern=r"^(cpu|mps|cuda(:\d+)?)$")] = "cpu"
    """Where the networks run: `cpu`, `cuda`, `cuda:1`, `mps`. Rendering stays on the CPU."""
    view_prompts: bool = True

    @property
    def source(self) -> str:
        """What guides, for messages and records: the model, or the name of another module's guidance."""
        return self.model if self.kind.kind == "diffusion" else self.kind.kind


class CamerasConfig(Section):
    radius: Positive = 3.0
    elevation_deg: Range = (-10.0, 45.0)
    fov_deg: Range = (38.0, 45.0)
    centre_jitter: NonNegative = 0.0
    aim: Literal["origin", "object"] = "origin"
    """What the cameras look at: the base's centre, or the centre of base and focal regions together."""
    focus_fraction: Fraction = 0.0
    """Share of the steps whose views are centred on the focal regions and close."""


class OutputConfig(Section):
    sheet_every: Annotated[int, Field(ge=0)] = 250
    checkpoint_every: Count = 100
    checkpoints_kept: Count = 2
    turntable_frames: Count = 48
    turntable_size: Annotated[int, Field(ge=16)] = 256
    texture_size: Annotated[int, Field(ge=16, le=8192)] = 1024
    """Texels a side of each exported part's pictures."""
