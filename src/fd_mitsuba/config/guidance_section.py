"""The section `guidance` of a run's settings: the model, what is added to it, and how its gradient is made."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from fd_mitsuba.config.bounds import GuidanceScale, ModelName, Range, Views, Weight
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.config.identity import MAY_CHANGE
from fd_mitsuba.config.section import Section
from fd_mitsuba.conventions import NormalAugmentation, Weighting


def _as_list(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


_Files = Annotated[tuple[ModelName, ...], BeforeValidator(_as_list)]
"""Paths; one alone needs no brackets."""


class GuidanceConfig(Section):
    """The model that guides both stages, and how its gradient is made."""

    kind: Choice = Choice(kind="diffusion")
    """What guides: the diffusion model of the keys below, or a guidance of another module with its own settings."""
    model: ModelName = "builtin"
    """`builtin`, `builtin-wide`, a folder in Stable-Diffusion layout, or a hub id."""
    lora: _Files = ()
    """LoRA files (.safetensors), or folders with one each, added to the model's weights."""
    lora_scale: Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)] = 1.0
    """How much of each is added."""
    words: _Files = ()
    """Learned words for prompts (textual inversion): .safetensors files, or folders with one each."""
    image_prompt: ModelName = ""
    """A picture that the material is to resemble, beside the prompt; appearance stage, through an IP-Adapter."""
    ip_adapter: ModelName = ""
    """The IP-Adapter's .safetensors file, or a folder with one; a plain one for the model."""
    ip_adapter_encoder: ModelName = ""
    """The folder of the image encoder that the IP-Adapter was made with."""
    image_prompt_scale: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 1.0
    """How much the picture counts."""
    controlnet: ModelName = ""
    """A ControlNet's folder or hub id, which is shown the surface in the appearance stage; none by default."""
    controlnet_scale: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 1.0
    """How much the ControlNet steers."""
    controlnet_sees: Literal["depth", "normal"] = "depth"
    """What of the surface it is shown; what it was trained with."""
    variant: Choice = Choice(kind="sds")
    """What makes the gradient: `sds`, `csd`, `ism`, `reconstruction`, `vsd`; see `guidance.variants`."""
    guidance_scale: GuidanceScale = 100.0
    """Written as diffusers does: uncond + w (text - uncond)."""
    image_guidance_scale: GuidanceScale = 1.0
    """Weight of the base's image, for models that see it whole (8 input channels, or 9 with `sees_region`)."""
    perp_neg: Weight = 0.0
    """Perp-Neg: weight of what the negative prompt asks for beside the prompt; 0: it stands for the empty text."""
    mask_margin: Annotated[int, Field(ge=0, le=64)] = 2
    """Inpainting models (9 input channels) repaint the focal regions and so many latent cells around them."""
    weighting: Weighting = "sds"
    """Weight of a timestep; `guidance.sds` has the formulas."""
    timestep_range_coarse: Range = (0.02, 0.35)
    """Noise levels that are drawn in the coarse phase, as shares of all timesteps."""
    timestep_range_drafted: Range = (0.02, 0.6)
    """The same once the part has been drafted (`geometry.draft_fraction`): what it is to be is decided then."""
    timestep_range_refined: Range = (0.02, 0.35)
    """The same in the refined phase."""
    timestep_annealing: Literal["none", "linear", "sqrt"] = "none"
    """`none` draws t; the others go through the range from its upper to its lower end, once a phase."""
    mask_channel: Literal["auto", "unit", "signed"] = "auto"
    """The coarse phase's mask: `unit` 0 to 1, as in the paper; `signed` -1 to 1; `auto`: `signed` for packed priors."""
    normal_augmentation: NormalAugmentation = "none"
    """Random turns of the coarse phase's normals, a view each: the paper names an augmentation and not which."""
    refined_background: Literal["black", "grey", "white"] = "black"
    """Behind the normals of the refined phase, as colours."""
    reduction: Literal["mean", "sum"] = "mean"
    """Of the gradients of a step's pictures."""
    normalise_gradient: bool = False
    """Bring the guidance's gradient to a fixed size, so that the other weights are relative to it."""
    views_per_call: Annotated[Views, MAY_CHANGE] = 4
    """Pictures sent through the UNet at once; fewer need less memory."""
    dtype: Literal["float32", "bfloat16", "float16"] = "float32"
    """Precision of the UNet; the VAE stays in float32."""
    device: Annotated[str, Field(pattern=r"^(cpu|mps|cuda(:\d{1,3})?)$"), MAY_CHANGE] = "cpu"
    """Where the networks run: `cpu`, `cuda`, `cuda:1`, `mps`; on `cuda` the texture field, too."""
    view_prompts: bool = True
    """Add words for the view's direction to the prompt."""

    @property
    def source(self) -> str:
        """What guides, for messages and records: the model, or the name of another module's guidance."""
        return self.model if self.kind.kind == "diffusion" else self.kind.kind
