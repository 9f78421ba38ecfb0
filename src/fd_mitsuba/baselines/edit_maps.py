"""Where an edit is in single views of an object: by attention to words, or by what the prompt changes.

Vox-E looks at the cross-attention of a UNet at one noise level. A small prior may tell words apart without looking at
different places for them; then the difference of two predictions shows the place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d

from fd_mitsuba.baselines.image_editors.by_prior import single_view_prompts
from fd_mitsuba.baselines.interface import EditTask, mesh_images, to_world_space
from fd_mitsuba.baselines.voxels.attention import recorded_attention, split_words, token_places, word_maps
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import Views
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for

ATTENTION_SIDE = 16
"""Side of the attention layers that count."""
DRAWS = 2
"""Of noise, for a map of differences."""
_OUTLIERS = 0.99

Shown = Callable[[CameraBatch, int], tuple[Tensor, Tensor]]
"""Makes normals times coverage (N, 3, size, size), in the settings' space, and coverage, of N cameras."""


class MapSettings(Section):
    """Of what says where the edit is."""

    maps: Literal["auto", "attention", "difference"] = "auto"
    """What says where the edit is: `attention` to its words, as in the original; `difference` of what the network sees
    with the prompt and with the base prompt; `auto`: the latter for priors of this package, whose attention is flat."""
    edit_word: str = ""
    """The prompt's word for what is new; none: the words that the base prompt has not."""
    attention_views: Views = 24
    """Views whose attention is recorded."""
    attention_time: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """The noise level at which it is, as a share of all timesteps; the original's."""

    @property
    def needs(self) -> str:
        """For messages: which method needs a map, and what helps."""
        return "the method needs a diffusion model that sees one whole image"


@dataclass(frozen=True)
class MapSource:
    """Whether a map is one of attention, and if so to which words of the edit and of the object."""

    by_words: bool
    words: tuple[list[str], list[str]]

    def calls(self, views: int) -> int:
        """Calls of the network for the maps of so many views."""
        return views * (1 if self.by_words else DRAWS)


def map_source(task: EditTask, settings: MapSettings) -> MapSource:
    """What the maps go by; UserError where neither kind can be had, or no word is the edit's."""
    guidance = refuse_without_attention(task, settings)
    scene = task.scene
    if settings.maps == "attention" or (settings.maps == "auto" and not guidance.conventions.is_packed):
        return MapSource(True, split_words(scene.prompt, scene.base_prompt, settings.edit_word))
    if not scene.base_prompt:
        raise UserError(f"{scene.path}: has no base_prompt, which the prompt is compared with; add one")
    return MapSource(False, ([], []))


def edit_maps(task: EditTask, settings: MapSettings, source: MapSource, shown: Shown, cameras: CameraBatch) -> Tensor:
    """(N, 2, s, s) in [0, 1]: where in views of an object the edit is, and where the rest."""
    seen = looked_at(task, settings, shown, cameras)
    if not source.by_words:
        return difference_maps(task, settings, seen, cameras)
    maps = attention_maps(task, settings, seen, cameras, source.words)
    return maps / maps.amax(dim=(0, 2, 3), keepdim=True).clamp(min=1e-12)


def refuse_without_attention(task: EditTask, settings: MapSettings) -> DiffusionGuidance:
    """The task's guidance; UserError where it has no cross-attention to look at."""
    guidance = task.guidance.inner
    if not isinstance(guidance, DiffusionGuidance) or guidance.inpaints or guidance.takes_cameras:
        raise UserError(f"guidance.model = {task.config.guidance.source}: {settings.needs}")
    return guidance


@dataclass(frozen=True)
class LookedAt:
    """Single views of an object as the network is given them.

    Attributes:
        z: (N, 4, L, L) latents of the views; beside: what it sees of the base beside them.
        level: the timestep.
    """

    z: Tensor
    beside: Beside
    level: int

    def noised(self, guidance: DiffusionGuidance, seed: int) -> Tensor:
        """The latents with noise, the same for every view."""
        noise = torch.randn(1, *self.z.shape[1:], generator=torch.Generator().manual_seed(seed)).to(self.z.device)
        return sds.add_noise(self.z, noise.expand_as(self.z), guidance.alpha_bars[[self.level] * len(self.z)]).float()

    def some(self, rows: slice) -> LookedAt:
        """Some of the views."""
        return LookedAt(self.z[rows], self.beside.rows(rows), self.level)


@torch.no_grad()
def looked_at(task: EditTask, settings: MapSettings, shown: Shown, cameras: CameraBatch) -> LookedAt:
    """The views of `cameras`, each as one image of the network's full size."""
    guidance = refuse_without_attention(task, settings)
    phase = task.own.phase_of(max(task.own.steps - 1, 0))[0]
    size = guidance.latent_size if phase == "coarse" else guidance.latents.picture_side
    normal, mask = shown(cameras, size)
    known = mesh_images(base_mesh(task.scene), cameras, size)
    in_world = task.config.geometry.normal_space == "world"
    base_normal = to_world_space(known.values, cameras) if in_world else known.values
    images = torch.cat([normal, mask, mask], dim=1).to(guidance.device)
    base = torch.cat([base_normal, known.mask, known.mask], dim=1).to(guidance.device)
    rows, seen = [], []
    for view in range(len(cameras)):
        few = slice(view, view + 1)
        rows.append(guidance.encode(images[few], phase))
        if guidance.has_image_pass:
            seen.append(guidance.seen_base(base[few], phase))
    level = round(settings.attention_time * (len(guidance.alpha_bars) - 1))
    return LookedAt(torch.cat(rows), Beside(torch.cat(seen) if seen else None), level)


@torch.no_grad()
def attention_maps(
    task: EditTask, settings: MapSettings, seen: LookedAt, cameras: CameraBatch, words: tuple[list[str], list[str]]
) -> Tensor:
    """(N, 2, 16, 16) attention to the words of the edit and of the object, in single views.

    Raises:
        UserError: the guidance is no diffusion model, or does not read the edit's words.
    """
    guidance = refuse_without_attention(task, settings)
    z_t = seen.noised(guidance, seed_for(task.config.seed, Purpose.GUIDANCE))
    tokenizer, rows = guidance.components.tokenizer, []
    for view, text in enumerate(single_view_prompts(guidance, cameras)):
        groups = [token_places(tokenizer, text, some) for some in words]
        if not groups[0]:
            raise UserError(
                f"the guidance model reads {text!r}, in which {', '.join(words[0])} is not; name a word of it with "
                "edit_word"
            )
        groups[1] = groups[1] or [at for at in range(1, len(tokenizer(text).input_ids) - 1) if at not in groups[0]]
        few = slice(view, view + 1)
        texts, times = guidance.embeddings([text], ("text",)), torch.tensor([seen.level], device=guidance.device)
        # One view at a time: several threads would mix up whose attention is whose.
        with recorded_attention(guidance.components.unet) as maps:
            guidance.predict_noise(z_t[few], times, texts, seen.some(few).beside)
        rows.append(word_maps(maps, groups, ATTENTION_SIDE))
    return torch.stack(rows)


@torch.no_grad()
def difference_maps(task: EditTask, settings: MapSettings, seen: LookedAt, cameras: CameraBatch) -> Tensor:
    """(N, 2, L, L) where the network sees something else with the prompt than with the base prompt, and the rest.

        d = mean over channels and draws of |e(prompt) - e(base prompt)|, smoothed, over its 99th percentile, at most 1

    and 1 - d (DiffEdit, arXiv 2210.11427).
    """
    guidance = refuse_without_attention(task, settings)
    prompts, plain = (single_view_prompts(guidance, cameras, text) for text in (None, task.scene.base_prompt))
    texts = {name: guidance.embeddings(some, ("text",))["text"] for name, some in (("text", prompts), ("plain", plain))}
    rows = []
    for view in range(len(cameras)):
        few, found = slice(view, view + 1), torch.zeros(1)
        for draw in range(DRAWS):
            z_t = seen.some(few).noised(guidance, seed_for(task.config.seed, Purpose.GUIDANCE, draw))
            times = torch.tensor([seen.level], device=guidance.device)
            both = [
                guidance.predict_noise(z_t, times, {"text": text[few]}, seen.some(few).beside)["text"]
                for text in texts.values()
            ]
            found = found + (both[0] - both[1]).abs().mean(dim=1, keepdim=True).cpu()
        rows.append(avg_pool2d(found, 5, stride=1, padding=2))
    share = torch.cat(rows)
    share = (share / torch.quantile(share, _OUTLIERS).clamp(min=1e-12)).clamp(max=1)
    return torch.cat([share, 1 - share], dim=1)
