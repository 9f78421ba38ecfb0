"""What the pictures of a step are to show: the scene's texts, and the parts' own where their regions are seen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.guidance.chunk import Area
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceViews
from fd_mitsuba.guidance.model_conventions import ModelConventions
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.guidance.prompts import TextEmbeddings, unknown_words, view_prompt


class SceneTexts:
    """The prompts, as the network reads them.

    Args:
        embed: the model's text encoder.
        conventions: the model's; with its template for prompts.
        config: settings of the model.
        latent_size: cells a side of the latents.
        device: where the network runs.
    """

    def __init__(
        self,
        embed: TextEmbeddings,
        conventions: ModelConventions,
        config: GuidanceConfig,
        latent_size: int,
        device: torch.device,
    ) -> None:
        self.embed, self._conventions, self._config = embed, conventions, config
        self._latent_size, self._device = latent_size, device
        self._prompt: str | None = None
        self._negative_prompt = ""
        self.of_parts: dict[str, tuple[str, str]] = {}

    def set_prompt(self, prompt: str, negative_prompt: str) -> list[str]:
        """See `DiffusionGuidance.set_prompt`."""
        self._prompt, self._negative_prompt = prompt, negative_prompt
        if not self._conventions.whole_words:
            return []
        return unknown_words(self.embed.tokenizer, f"{prompt} {negative_prompt}")

    def set_part_prompts(self, prompts: Mapping[str, tuple[str, str]]) -> None:
        """See `DiffusionGuidance.set_part_prompts`."""
        self.of_parts = dict(prompts)

    def prompts(self, views: GuidanceViews | AppearanceViews, text: str | None = None) -> list[str]:
        """See `DiffusionGuidance.prompts`."""
        text = self._prompt if text is None else text
        if text is None:
            raise ValueError("set_prompt must be called before guide")
        return [
            view_prompt(text, float(azimuth), views.closeup, self._conventions, self._config.view_prompts)
            for azimuth in list(views.azimuth_deg)[:: self._conventions.view_grid**2]
        ]

    def embeddings(self, prompts: list[str], passes: Iterable[str], negative: str = "") -> dict[str, Tensor]:
        """See `DiffusionGuidance.embeddings`."""
        against = negative or self._negative_prompt
        read = {"text": prompts, "negative": [against] * len(prompts)}
        without = ["" if self._config.perp_neg else against] * len(prompts)
        return {name: self.embed(read.get(name, without)) for name in passes}

    def areas(self, views: GuidanceViews | AppearanceViews, passes: Iterable[str]) -> tuple[Area, ...]:
        """Where the parts with texts of their own are seen; a pass that reads the same as elsewhere is left out, and so
        is a part that no view shows.
        """
        found = []
        for part, (prompt, negative) in self.of_parts.items():
            if part not in views.regions:
                raise ValueError(f"part {part!r} has a prompt, and the views do not say where its regions are seen")
            if not bool((views.regions[part] > 0).any()):
                continue
            own = own_passes(negative, self._negative_prompt, self._config.perp_neg, passes)
            mask = tile_views(views.regions[part], self._conventions.view_grid).to(self._device)
            texts = self.embeddings(self.prompts(views, prompt), own, negative)
            found.append(Area(adaptive_avg_pool2d(mask, self._latent_size), texts))
        return tuple(found)


def own_passes(negative: str, of_scene: str, perp_neg: float, passes: Iterable[str]) -> list[str]:
    """Those of the network's passes in which a part with a prompt and a negative prompt reads something of its own.

    Args:
        negative: the part's; "" is that of the scene.
        of_scene: the scene's.
    """
    own = {"text"} if negative in ("", of_scene) else set(passes)
    if perp_neg:
        own &= {"text", "negative"}
    return [name for name in passes if name in own]
