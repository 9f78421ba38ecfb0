"""Where an edit is in single views of a voxel grid: by attention to words, or by what the prompt changes.

Vox-E looks at the cross-attention of a UNet at one noise level. A small prior may tell words apart without looking at
different places for them; then the difference of two predictions shows the place.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from fd_mitsuba.baselines.image_editors.by_prior import single_view_prompts
from fd_mitsuba.baselines.interface import EditTask, mesh_images
from fd_mitsuba.baselines.voxels.attention import recorded_attention, token_places, word_maps
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.rendering import render_normals
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.seeds import Purpose, seed_for

ATTENTION_SIDE = 16
"""Side of the attention layers that count."""
DRAWS = 2
"""Of noise, for a map of differences."""
_OUTLIERS = 0.99


def refuse_without_attention(task: EditTask) -> DiffusionGuidance:
    """The task's guidance; UserError where it has no cross-attention to look at."""
    guidance = task.guidance.inner
    if not isinstance(guidance, DiffusionGuidance) or guidance.inpaints or guidance.takes_cameras:
        raise UserError(
            f"guidance.model = {task.config.guidance.source}: voxe needs a diffusion model that sees one whole image; "
            "take voxe_global instead"
        )
    return guidance


@dataclass(frozen=True)
class LookedAt:
    """Single views of an edited grid as the network is given them.

    Attributes:
        z: (N, 4, L, L) latents of the views; condition: what it sees of the base beside them, or None.
        level: the timestep.
    """

    z: Tensor
    condition: Tensor | None
    level: int

    def noised(self, guidance: DiffusionGuidance, seed: int) -> Tensor:
        """The latents with noise, the same for every view."""
        noise = torch.randn(1, *self.z.shape[1:], generator=torch.Generator().manual_seed(seed)).to(self.z.device)
        return sds.add_noise(self.z, noise.expand_as(self.z), guidance.alpha_bars[[self.level] * len(self.z)]).float()

    def some(self, rows: slice) -> LookedAt:
        """Some of the views."""
        return LookedAt(self.z[rows], None if self.condition is None else self.condition[rows], self.level)


@torch.no_grad()
def looked_at(task: EditTask, grid: VoxelGrid, cameras: CameraBatch, samples: int, time: float) -> LookedAt:
    """The views of `cameras`, each as one image of the network's full size.

    Args:
        samples: pieces of a ray. time: the timestep, as a share of all.
    """
    guidance = refuse_without_attention(task)
    phase = task.own.phase_of(max(task.own.steps - 1, 0))[0]
    size = guidance.latent_size if phase == "coarse" else guidance.latents.picture_side
    normal, mask = render_normals(grid, cameras, size, samples, space=task.config.geometry.normal_space)
    known = mesh_images(base_mesh(task.scene), cameras, size)
    shown = torch.cat([normal, mask, mask], dim=1).to(guidance.device)
    base = torch.cat([known.values, known.mask, known.mask], dim=1).to(guidance.device)
    rows, seen = [], []
    for view in range(len(cameras)):
        few = slice(view, view + 1)
        rows.append(guidance.encode(shown[few], phase))
        if guidance.has_image_pass:
            seen.append(guidance.seen_base(base[few], phase))
    level = round(time * (len(guidance.alpha_bars) - 1))
    return LookedAt(torch.cat(rows), torch.cat(seen) if seen else None, level)


@torch.no_grad()
def attention_maps(task: EditTask, seen: LookedAt, cameras: CameraBatch, words: tuple[list[str], list[str]]) -> Tensor:
    """(N, 2, 16, 16) attention to the words of the edit and of the object, in single views of the edited grid.

    Raises:
        UserError: the guidance is no diffusion model, or does not read the edit's words.
    """
    guidance = refuse_without_attention(task)
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
            guidance.predict_noise(z_t[few], times, texts, seen.some(few).condition)
        rows.append(word_maps(maps, groups, ATTENTION_SIDE))
    return torch.stack(rows)


@torch.no_grad()
def difference_maps(task: EditTask, seen: LookedAt, cameras: CameraBatch) -> Tensor:
    """(N, 2, L, L) where the network sees something else with the prompt than with the base prompt, and the rest.

        d = mean over channels and draws of |e(prompt) - e(base prompt)|, smoothed, over its 99th percentile, at most 1

    and 1 - d (DiffEdit, arXiv 2210.11427).
    """
    guidance = refuse_without_attention(task)
    prompts, plain = (single_view_prompts(guidance, cameras, text) for text in (None, task.scene.base_prompt))
    texts = {name: guidance.embeddings(some, ("text",))["text"] for name, some in (("text", prompts), ("plain", plain))}
    rows = []
    for view in range(len(cameras)):
        few, found = slice(view, view + 1), torch.zeros(1)
        for draw in range(DRAWS):
            z_t = seen.some(few).noised(guidance, seed_for(task.config.seed, Purpose.GUIDANCE, draw))
            times = torch.tensor([seen.level], device=guidance.device)
            both = [
                guidance.predict_noise(z_t, times, {"text": text[few]}, seen.some(few).condition)["text"]
                for text in texts.values()
            ]
            found = found + (both[0] - both[1]).abs().mean(dim=1, keepdim=True).cpu()
        rows.append(avg_pool2d(found, 5, stride=1, padding=2))
    share = torch.cat(rows)
    share = (share / torch.quantile(share, _OUTLIERS).clamp(min=1e-12)).clamp(max=1)
    return torch.cat([share, 1 - share], dim=1)
