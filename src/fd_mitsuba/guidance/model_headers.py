"""What a pipeline's configs and file headers say of it: all that can be refused before any weights are read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.image_prompt import asks_for_image_prompt
from fd_mitsuba.guidance.layout import (
    WEIGHTS,
    check_scheduler,
    check_sizes,
    count_weights,
    read_json,
    read_layout,
    weight_files,
)
from fd_mitsuba.guidance.model_conventions import ModelConventions, read_model_conventions
from fd_mitsuba.guidance.multiview_layout import ORIGINAL_CLASS, multiview_conventions, unet_config


@dataclass(frozen=True)
class ModelHeaders:
    """Of a pipeline that fits the settings.

    Attributes:
        index: `model_index.json`.
        configs: of the components with weights; the UNet's in Diffusers' terms.
        is_original: whether the UNet's weights have the names of the original latent diffusion code.
        variants: of the components' files, as `weight_files`.
        counts: of the components' weights.
    """

    folder: Path
    index: dict[str, Any]
    configs: dict[str, dict[str, Any]]
    is_original: bool
    conventions: ModelConventions
    files: dict[str, list[Path]]
    variants: dict[str, str | None]
    counts: dict[str, int]

    @property
    def view_grid(self) -> int:
        """As `Guidance.view_grid`."""
        return self.conventions.view_grid

    @property
    def views_together(self) -> int:
        """As `Denoiser.views_together`."""
        return self.conventions.views_together or 1


def read_headers(folder: Path, config: GuidanceConfig) -> ModelHeaders:
    """The headers of a pipeline folder.

    Raises:
        UserError: a layout other than Stable Diffusion's, a missing or damaged file, configs that do not fit each
            other, settings that do not go with the model or with each other.
    """
    index = read_layout(folder)
    configs = {part: read_json(folder / part / "config.json") for part in WEIGHTS}
    original = configs["unet"].get("_class_name") == ORIGINAL_CLASS
    configs["unet"] = unet_config(folder / "unet" / "config.json", configs["unet"])
    conventions = multiview_conventions(folder, configs["unet"], read_model_conventions(folder), config)
    check_sizes(folder, configs, conventions)
    check_scheduler(folder, configs["unet"], conventions)
    found = {part: weight_files(folder, part) for part in WEIGHTS}
    files = {part: paths for part, (paths, _) in found.items()}
    counts = {part: sum(map(count_weights, paths)) for part, paths in files.items()}
    with_picture = asks_for_image_prompt(config)
    if (config.lora or config.words or config.controlnet or with_picture) and is_builtin(config.model):
        raise UserError(
            "guidance.lora, words, image_prompt and controlnet are made for Stable Diffusion; set guidance.model to "
            "such a model"
        )
    variants = {part: variant for part, (_, variant) in found.items()}
    return ModelHeaders(folder, index, configs, original, conventions, files, variants, counts)
