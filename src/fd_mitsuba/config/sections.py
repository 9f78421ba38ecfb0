"""The sections of a run's settings: one frozen, strict model each. `config` puts them together and reads them.

That of the guidance has a file of its own, `guidance_section.py`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from fd_mitsuba.config.bounds import (
    MOST_SAMPLES,
    MOST_TURNTABLE_PIXELS,
    Cells,
    Features,
    Fraction,
    GuidanceScale,
    Length,
    Levels,
    Neurons,
    Points,
    Range,
    Rate,
    Samples,
    Steps,
    Views,
    Weight,
    Width,
)
from fd_mitsuba.config.choice import Weighted
from fd_mitsuba.config.identity import MAY_CHANGE
from fd_mitsuba.config.section import Section
from fd_mitsuba.conventions import NormalSpace, TextureChannel, Weighting


class FieldConfig(Section):
    """The editable part's network: a hash grid and a two-layer MLP (paper, supplement "Geometry Learning")."""

    levels: Levels = 10
    """Number of resolutions of the hash grid."""
    features: Features = 2
    """Learned numbers of an entry of the grid."""
    base_resolution: Cells = 8
    """Cells a side of the coarsest level."""
    finest_resolution: Cells = 128
    """Cells a side of the finest level; the levels between grow by a constant factor."""
    log2_table: Annotated[int, Field(ge=4, le=24)] = 15
    """A level of the grid holds at most 2^log2_table entries."""
    hidden: Neurons = 32
    """Width of the network's hidden layer."""
    offsets: bool = True
    """Let vertices of the tetrahedral grid move by up to half a cell, where the base's surface is not touched."""


class OptimisedSection(Section):
    """What both stages say of AdamW, beside their step sizes."""

    betas: Range = (0.9, 0.99)
    """Decay rates of AdamW's running averages."""
    eps: Rate = 1e-15
    """Smallest divisor in a step of AdamW."""
    fade: Fraction = 0.0
    """Share of the steps, the last ones, over which the step size falls to zero; not in the paper."""
    weight_decay: Fraction = 0.01
    """Weight decay of AdamW."""


class GeometryConfig(OptimisedSection):
    """The geometry stage: its steps, the union with the base, and the losses on the part's signed distance."""

    steps: Steps = 3000
    """Steps of the geometry stage."""
    coarse_fraction: Fraction = 2 / 3
    """Share of the steps in the coarse phase; the rest is the refined phase."""
    learning_rate: Rate = 1e-3
    """Step size of AdamW."""
    average: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """The part that is exported has an average of the field's weights over the steps, with this factor a step:
    smoother, and less sharp where the shape still changes. 0: the last step's own; not in the paper."""
    draft_fraction: Fraction = 0.0
    """Share of the coarse phase's steps, the first ones, that follow a picture which the model draws of the edited
    object, where it can: the built-in priors and their like. The part begins as the picture's visual hull. 0: nothing
    is drawn; not in the paper."""
    grid_resolution: Annotated[int, Field(ge=8, le=256)] = 64
    """Cells a side of the tetrahedral grid: 64 has 275k vertices, 128 has 2.1M."""
    union_k: Length = 0.15
    """Width of the fillet between base and part in canonical units; the paper's k."""
    union_only_outside: bool = False
    """Blend only outside of both, so that neither swells inside the other."""
    start_variety: Fraction = 0.0
    """How much seeds other than 0 vary what the part starts as, within its regions; not in the paper."""
    lambda_sds: Weight = 1.0
    """Weight of the guidance's loss."""
    lambda_focal: Weight = 1000.0
    """Weight of `loss_focal`, which keeps the part in its focal regions; the paper's L_GF."""
    focal_sigma_distance: Width = 0.05
    """Softness of the region's border in `loss_focal`, canonical units squared; the paper's sigma_1."""
    focal_sigma_sdf: Width = 0.01
    """Softness of the part's border in `loss_focal`, canonical units; the paper's sigma_2."""
    focal_margin: Length = 0.0
    """The paper's xi: also punishes an SDF that is negative by less than this."""
    focal_band: Length = 0.05
    """Distance around the focal region, in canonical units, in which the part may overrun for free."""
    focal_samples: Points = 10240
    """Vertices of the grid near the regions at which the losses on the field are taken, a step."""
    lambda_collision: Weight = 100.0
    """Weight of `loss_collision`, which keeps the part out of the base; the paper's L_CA."""
    lambda_volume: Weight = 0.0
    """Weight of a penalty on the share of the space that the part fills; not in the paper."""
    lambda_presence: Weight = 0.0
    """Weight of the loss that leaves no focal region without a part; not in the paper."""
    presence_share: Annotated[float, Field(gt=0, le=1)] = 0.02
    """Share of each region, outside the base, that it keeps filled."""
    lambda_tether: Weight = 0.0
    """Weight of the loss that keeps pieces of the part from coming loose from the base; not in the paper."""
    lambda_curvature: Weight = 0.0
    """Weight of a penalty on curvature of the part's surface that spares edges; not in the paper."""
    losses: dict[str, Weighted] = {}
    """Losses of other modules by name, each with its `lambda` and its own settings; see docs/extending.md."""
    views: Views = 4
    """Cameras a step."""
    spp: Samples = 4
    """Samples a pixel."""
    silhouette_spp: Samples = 1
    """Points on outlines, for each pixel of an image; they carry the gradient of the silhouettes."""
    normal_space: NormalSpace = "camera"
    """Frame of the normals that are rendered."""

    @model_validator(mode="after")
    def _samples_can_be_numbered(self) -> GeometryConfig:
        coarse, refined = 64**2 * (self.spp + self.silhouette_spp), 512**2 * (1 + self.silhouette_spp)
        samples = self.views * (max(coarse, refined) if self.coarse_fraction < 1 else coarse)
        if samples > MOST_SAMPLES:
            raise ValueError(
                f"geometry.views, spp and silhouette_spp make {samples} samples a step, at most {MOST_SAMPLES} are "
                "possible"
            )
        return self


class TextureConfig(Section):
    """The part's texture field: a hash grid and an MLP with one hidden layer (supplement "PBR Material")."""

    levels: Levels = 12
    """Number of resolutions of the hash grid."""
    features: Features = 2
    """Learned numbers of an entry of the grid."""
    base_resolution: Cells = 16
    """Cells a side of the coarsest level."""
    finest_resolution: Cells = 1024
    """Cells a side of the finest level."""
    log2_table: Annotated[int, Field(ge=4, le=24)] = 16
    """A level of the grid holds at most 2^log2_table entries."""
    hidden: Neurons = 32
    """Width of the network's hidden layer."""
    base_color_range: Range = (0.03, 0.94)
    """Above 0.94 a `principled` returns more light than it gets, since its highlight comes on top of the rest."""
    roughness_range: Range = (0.08, 1.0)
    """Least and greatest roughness that can be learned."""
    metallic_range: Range = (0.0, 1.0)
    """Least and greatest metallic that can be learned."""
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


class AppearanceConfig(OptimisedSection):
    """The appearance stage: what is rendered, what may be learned, and the losses on the material."""

    steps: Steps = 2000
    """Steps of the appearance stage."""
    learning_rate: Rate = 1e-2
    """Step size of AdamW."""
    views: Views = 4
    """Cameras a step."""
    picture_size: Annotated[int, Field(ge=16, le=4096)] | None = None
    """Side of a rendered view in pixels; none: what the guidance model works with."""
    spp: Samples = 16
    """Samples a pixel."""
    max_depth: Annotated[int, Field(ge=-1, le=1000)] = 2
    """As Mitsuba's `path`: 2 is direct light with shadows, more adds bounces, -1 does not end them."""
    exposure: Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)] | None = None
    """Factor on linear colour before the sRGB curve; none: chosen once from the base as it is lit."""
    background: Literal["black", "white", "random", "light"] = "white"
    """What is behind the object; `light` is the environment."""
    normal_map: bool = True
    """Whether the field may bend shading normals."""
    fixed: tuple[TextureChannel, ...] = ()
    """Channels that keep the values of the scene's part BSDF."""
    timestep_range: Range = (0.02, 0.98)
    """Noise levels that are drawn, as shares of all timesteps."""
    weighting: Weighting = "inverse"
    """Weight of a timestep; `guidance.sds` has the formulas."""
    guidance_scale: GuidanceScale = 100.0
    """As `guidance.guidance_scale`, for this stage."""
    image_guidance_scale: GuidanceScale = 1.0
    """As `guidance.image_guidance_scale`, for this stage."""
    mask_guidance: bool = True
    """Noise and gradient only where the part is seen."""
    soft_mask: bool = False
    """They fade with the share of a latent cell that the part covers, instead of ending where it is below a tenth."""
    lambda_sds: Weight = 1.0
    """Weight of the guidance's loss."""
    style: bool = False
    """Style consistency with the base, for parts that continue its material; most edits do without."""
    lambda_style: Weight = 10.0
    """Weight of `loss_style_gradient`: the material varies slowly. Counts with `style`."""
    lambda_boundary: Weight = 100.0
    """Weight of `loss_style_boundary`: where the part meets the base it has its material. Counts with `style`."""
    style_samples: Points = 2048
    """Points of the part's surface for these two losses, a step."""
    style_jitter: Width = 0.01
    """Standard deviation of the paper's delta, canonical units."""
    boundary_reach: Width = 0.03
    """The part's boundary is its surface within this distance of the base, canonical units."""
    lambda_bend: Weight = 0.0
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
        samples = self.views * (self.picture_size or 32) ** 2 * self.spp
        if samples > MOST_SAMPLES:
            raise ValueError(
                f"appearance.views x picture_size x picture_size x spp = {samples} samples a step, "
                f"at most {MOST_SAMPLES} are possible"
            )
        return self


class CamerasConfig(Section):
    """From where the training images are seen; azimuths are spread around the object."""

    radius: Annotated[float, Field(ge=0.5, le=100, allow_inf_nan=False)] = 3.0
    """Distance of the cameras, canonical units."""
    elevation_deg: Range = (-10.0, 45.0)
    """Lowest and highest elevation."""
    fov_deg: Range = (38.0, 45.0)
    """Least and greatest field of view."""
    centre_jitter: Length = 0.0
    """Half side of the cube in which the point lies that is looked at, canonical units."""
    aim: Literal["origin", "object"] = "origin"
    """What the cameras look at: the base's centre, or the centre of base and focal regions together."""
    focus_fraction: Fraction = 0.0
    """Share of the steps whose views are centred on the focal regions and close."""


class OutputConfig(Section):
    """What is written, how often and how large; nothing of it changes the part."""

    sheet_every: Annotated[int, Field(ge=0, le=1_000_000), MAY_CHANGE] = 250
    """Steps between contact sheets; 0: none."""
    checkpoint_every: Annotated[Steps, MAY_CHANGE] = 100
    """Steps between checkpoints."""
    checkpoints_kept: Annotated[Steps, MAY_CHANGE] = 2
    """How many of the newest checkpoints stay."""
    turntable_frames: Annotated[int, Field(ge=1, le=1000), MAY_CHANGE] = 48
    """Frames of a turntable."""
    turntable_size: Annotated[int, Field(ge=16, le=4096), MAY_CHANGE] = 256
    """Pixels a side of a turntable."""
    picture_size: Annotated[int, Field(ge=0, le=2048), MAY_CHANGE] = 1024
    """Pixels a side of the photographs of the finished object; 0: none, which saves their seconds."""
    faces: Annotated[int, Field(ge=100, le=2_000_000), MAY_CHANGE] = 20_000
    """Triangles of each exported part, at most: a small one gets fewer."""
    roughness_floor: Annotated[bool, MAY_CHANGE] = True
    """Bake a roughness that hides the noise of the part's own shading: a near-mirror would show it as streaks."""
    texture_size: Annotated[int, Field(ge=16, le=8192), MAY_CHANGE] = 1024
    """Texels a side of each exported part's pictures."""

    @model_validator(mode="after")
    def _turntable_fits(self) -> OutputConfig:
        pixels = self.turntable_frames * self.turntable_size**2
        if pixels > MOST_TURNTABLE_PIXELS:
            raise ValueError(
                f"output.turntable_frames x turntable_size x turntable_size = {pixels} pixels, at most "
                f"{MOST_TURNTABLE_PIXELS} are possible"
            )
        return self
