"""Which settings suit which guidance model: the choice where the user makes none, a warning where theirs do not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fd_mitsuba.config.guidance_section import GuidanceConfig
from fd_mitsuba.config.run_config import RunConfig
from fd_mitsuba.config.toml_reading import apply_override, read_toml
from fd_mitsuba.io.json_object import read_json_object

SMALL_PRESET, LARGE_PRESET = "quick", "paper"
BUILTIN, BUILTIN_WIDE = "builtin", "builtin-wide"
"""Names of the priors of shapes that are shipped; each goes with a prior of colours of its own."""
_CONVENTIONS_NAME = "fd_mitsuba.json"
"""In the folder of a prior that `prior pack` made; anyone may write one for views and prompts of another model."""


@dataclass(frozen=True)
class ChosenSettings:
    """Settings of a run, and how they were chosen where the user did not choose."""

    config: RunConfig
    remark: str | None


def is_builtin(model: str) -> bool:
    """Whether `guidance.model` names what is shipped with the package."""
    return model in (BUILTIN, BUILTIN_WIDE)


def is_small_prior(model: str) -> bool:
    """Whether `guidance.model` is a built-in prior or one that was packed like it."""
    return is_builtin(model) or _is_packed(Path(model).expanduser())


def _is_packed(folder: Path) -> bool:
    """As `ModelConventions.is_packed`, which is in a module that imports torch."""
    said = read_json_object(folder / _CONVENTIONS_NAME) or {}
    return said.get("whole_words") is True or said.get("vocabulary") is not None


def settings_for_run(choice: Path | str | None, overrides: Sequence[str] = ()) -> ChosenSettings:
    """The settings that the user chose; without a choice those that suit the guidance model, which a line names.

    Args:
        choice: as `source` of `RunConfig.load`; None: `quick` for the built-in prior and its like, `paper` otherwise.

    Raises:
        UserError: see `RunConfig.load`.
    """
    remark = None
    if choice is None:
        wanted: dict[str, Any] = {}
        for item in overrides:
            apply_override(wanted, item)
        guidance = wanted.get("guidance")
        model = str(guidance.get("model", BUILTIN)) if isinstance(guidance, dict) else BUILTIN
        choice = SMALL_PRESET if is_small_prior(model) else LARGE_PRESET
        whom = _called(model)
        remark = f"settings: {choice}, which suit {whom}; -c chooses others"
    return ChosenSettings(RunConfig.load(choice, overrides), remark)


def misfits(config: RunConfig) -> list[str]:
    """Lines on settings that do not fit the guidance model or have no effect; none where no model is used."""
    if config.guidance.kind.kind != "diffusion":
        return []
    if config.geometry.lambda_sds == 0 and config.appearance.lambda_sds == 0:
        return []
    idle = _idle(config.guidance)
    small = is_small_prior(config.guidance.model)
    rules = _SMALL if small else _LARGE
    wrong = [(key, _value(config, key)) for key, fits in rules.items() if not fits(_value(config, key))]
    if config.guidance.variant != GuidanceConfig().variant:  # each variant has a scale of its own
        wrong = [(key, value) for key, value in wrong if key != "guidance.guidance_scale"]
    if not wrong:
        return idle
    preset = SMALL_PRESET if small else LARGE_PRESET
    usual = RunConfig.load(read_toml(preset))
    named = ", ".join(f"{key} = {_text(value)} ({preset}: {_text(_value(usual, key))})" for key, value in wrong)
    whom = _called(config.guidance.model)
    other = "name a Stable Diffusion model in guidance.model" if small else "set guidance.model=builtin"
    return [f"settings that do not fit {whom}: {named}; use -c {preset}, or {other}", *idle]


def _idle(guidance: GuidanceConfig) -> list[str]:
    """A line for each setting of an addition to the model that is not there."""
    usual = GuidanceConfig()
    return [
        f"guidance.{key} = {_text(getattr(guidance, key))}: has no effect without guidance.{owner}; give that, too"
        for key, owner in _BELONGS_TO.items()
        if not getattr(guidance, owner) and getattr(guidance, key) != getattr(usual, key)
    ]


_BELONGS_TO = {
    "lora_scale": "lora",
    "image_prompt_scale": "image_prompt",
    "controlnet_scale": "controlnet",
    "controlnet_sees": "controlnet",
}


_SMALL: dict[str, Callable[[Any], bool]] = {
    "guidance.guidance_scale": lambda scale: scale <= 20,
    "guidance.timestep_range_coarse": lambda bounds: bounds[1] >= 0.6,
    "guidance.normalise_gradient": lambda normalised: normalised,
    "appearance.guidance_scale": lambda scale: scale <= 10,
    "appearance.background": lambda colour: colour == "black",
}
"""The built-in prior decides at high noise what a part becomes, and its gradient is small: see docs/prior.md."""
_LARGE: dict[str, Callable[[Any], bool]] = {
    "guidance.guidance_scale": lambda scale: scale >= 7,
    "appearance.guidance_scale": lambda scale: scale >= 7,
}
"""With the small scales of the built-in prior, score distillation of Stable Diffusion stays a blur (DreamFusion)."""


def _called(model: str) -> str:
    return {BUILTIN: "the built-in prior", BUILTIN_WIDE: "the wide built-in prior"}.get(model, model)


def _value(config: RunConfig, key: str) -> Any:
    section, name = key.split(".")
    return getattr(getattr(config, section), name)


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)
