"""The methods `voxe_global` and `voxe`: Vox-E without and with its refinement (arXiv 2303.12048), on normals.

A ReLU-field voxel grid is fitted to images of the base, and a copy of it is guided as a whole. The refinement keeps of
that what belongs to the edit, by the attention of the model to its words and a graph cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import avg_pool2d

from fd_mitsuba.baselines.image_editors.by_prior import single_view_prompts
from fd_mitsuba.baselines.interface import BASELINES, EditTask, mesh_images
from fd_mitsuba.baselines.voxels.attention import recorded_attention, split_words, token_places, word_maps
from fd_mitsuba.baselines.voxels.edit_stage import VoxelEditStage
from fd_mitsuba.baselines.voxels.edited import EditedVoxels
from fd_mitsuba.baselines.voxels.fitting import BaseRays, fit_cameras, fit_grid, fit_psnr
from fd_mitsuba.baselines.voxels.grid import VoxelGrid
from fd_mitsuba.baselines.voxels.refinement import CutSettings, as_large, attention_grids, edit_voxels, merged
from fd_mitsuba.baselines.voxels.rendering import render_normals
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import Points, Rate, Samples, Steps, Views, Weight
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.seeds import Purpose, seed_for

ATTENTION_SIDE, ATTENTION_SIZE = 16, 64
"""Side of the attention layers that count, and of the images that attention grids are fitted to."""
DRAWS = 2
"""Of noise, for a map of differences."""
_OUTLIERS = 0.99


class VoxeGlobalSettings(Section):
    """Of `voxe_global`."""

    resolution: Annotated[int, Field(ge=8, le=256)] = 64
    """Voxels a side; the original has 160."""
    samples: Samples = 64
    """Points along a ray; the original has 256."""
    fit_steps: Steps = 600
    """Steps of the fit to images of the base."""
    fit_views: Views = 48
    """How many images these are."""
    fit_size: Annotated[int, Field(ge=16, le=512)] = 128
    """Pixels a side of them."""
    fit_rays: Points = 2048
    """Rays of a step of the fit."""
    fit_learning_rate: Rate = 0.1
    """Of the fit; falls to a tenth."""
    learning_rate: Rate = 0.06
    """Of the edit. The original has 0.03 for twenty times as many steps as the quick settings have."""
    lambda_correlation: Weight = 30.0
    """Weight of the volumetric correlation loss. The original's 200 goes with gradients of another size: beside the
    quick settings' normalised ones it hardly lets the density change."""


def fitted_grid(settings: VoxeGlobalSettings, scene: EditScene, seed: int) -> tuple[VoxelGrid, float]:
    """A voxel grid of the scene's base, and the PSNR in dB of its images; see `fitting.fit_psnr`."""
    mesh, grid = base_mesh(scene), VoxelGrid(settings.resolution)
    aim = np.zeros(3)
    rays = BaseRays(mesh, fit_cameras(settings.fit_views, aim), settings.fit_size, grid.half_extent)
    fit_grid(
        grid, rays, settings.fit_steps, settings.fit_rays, settings.samples, settings.fit_learning_rate,
        seed_for(seed, Purpose.FIELD),
    )  # fmt: skip
    return grid, fit_psnr(grid, mesh, aim, 2 * settings.samples)


@BASELINES.register("voxe_global", VoxeGlobalSettings)
def voxe_global(settings: VoxeGlobalSettings, task: EditTask) -> EditedVoxels:
    """Vox-E-Global: a voxel grid fitted to the base and guided as a whole, with a volumetric correlation loss."""
    base, psnr = fitted_grid(settings, task.scene, task.config.seed)
    stage = VoxelEditStage(task.own, base, settings.samples, settings.learning_rate, settings.lambda_correlation)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    edited = EditedVoxels(task.scene, stage.field, {"fit_psnr_db": psnr})
    edited.guidance_calls = stage.steps
    return edited


class VoxeSettings(VoxeGlobalSettings):
    """Of `voxe`."""

    maps: Literal["auto", "attention", "difference"] = "auto"
    """What says where the edit is: `attention` to its words, as in the original; `difference` of what the network sees
    with the prompt and with the base prompt; `auto`: the latter for priors of this package, whose attention is flat."""
    edit_word: str = ""
    """The prompt's word for what is new; none: the words that the base prompt has not."""
    attention_views: Views = 24
    """Views whose attention is recorded."""
    attention_time: Annotated[float, Field(gt=0, lt=1)] = 0.2
    """The noise level at which it is, as a share of all timesteps; the original's."""
    attention_steps: Steps = 200
    """Steps of the fit of the attention grids."""
    lambda_tv: Weight = 0.01
    """Weight of their total variation; the original's."""
    cut_cost: Weight = 5.0
    """Cost of parting two equal neighbours; the original's."""
    cut_sigma: Annotated[float, Field(gt=0, le=100)] = 0.5
    """How fast that falls with the difference of their normals; the original has 0.1 for colours."""


@BASELINES.register("voxe", VoxeSettings)
def voxe(settings: VoxeSettings, task: EditTask) -> EditedVoxels:
    """Vox-E: as `voxe_global`, then only voxels that the attention to the edit's words marks stay edited."""
    by_words = looks_for_words(task, settings)
    words = split_words(task.scene.prompt, task.scene.base_prompt, settings.edit_word) if by_words else ([], [])
    base, psnr = fitted_grid(settings, task.scene, task.config.seed)
    stage = VoxelEditStage(task.own, base, settings.samples, settings.learning_rate, settings.lambda_correlation)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    cameras = fit_cameras(settings.attention_views, np.zeros(3))
    if by_words:
        maps = attention_maps(task, stage.field, cameras, words, settings)
        maps = maps / maps.amax(dim=(0, 2, 3), keepdim=True).clamp(min=1e-12)
    else:
        maps = difference_maps(task, stage.field, cameras, settings)
    maps = as_large(maps, ATTENTION_SIZE)
    values = attention_grids(stage.field, maps, cameras, settings.samples, settings.attention_steps, settings.lambda_tv)
    cut = CutSettings(settings.cut_cost, settings.cut_sigma, seed_for(task.config.seed, Purpose.SAMPLES))
    edit = edit_voxels(stage.field, values, cut)
    share = float(edit.sum()) / max(float((stage.field.density > 0).sum()), 1.0)
    edited = EditedVoxels(task.scene, merged(stage.field, base, edit), {"fit_psnr_db": psnr, "edited_share": share})
    edited.guidance_calls = stage.steps + settings.attention_views * (1 if by_words else DRAWS)
    return edited


def looks_for_words(task: EditTask, settings: VoxeSettings) -> bool:
    """Whether the maps are those of cross-attention; UserError where neither kind can be had."""
    guidance = refuse_without_attention(task)
    by_words = settings.maps == "attention" or (settings.maps == "auto" and not guidance.conventions.is_packed)
    if not by_words and not task.scene.base_prompt:
        raise UserError(f"{task.scene.path}: has no base_prompt, which voxe compares the prompt with; add one")
    return by_words


def refuse_without_attention(task: EditTask) -> DiffusionGuidance:
    """The task's guidance; UserError where it has no cross-attention to look at."""
    guidance = task.guidance.inner
    if not isinstance(guidance, DiffusionGuidance) or guidance.inpaints:
        raise UserError(
            f"guidance.model = {task.config.guidance.source}: voxe needs a diffusion model that sees the whole image; "
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
def looked_at(task: EditTask, grid: VoxelGrid, cameras: CameraBatch, settings: VoxeSettings) -> LookedAt:
    """The views of `cameras`, each as one image of the network's full size."""
    guidance = refuse_without_attention(task)
    phase = task.own.phase_of(max(task.own.steps - 1, 0))[0]
    size = guidance.latent_size if phase == "coarse" else guidance.latents.picture_side
    normal, mask = render_normals(grid, cameras, size, settings.samples, space=task.config.geometry.normal_space)
    known = mesh_images(base_mesh(task.scene), cameras, size)
    shown = torch.cat([normal, mask, mask], dim=1).to(guidance.device)
    base = torch.cat([known.values, known.mask, known.mask], dim=1).to(guidance.device)
    rows, seen = [], []
    for view in range(len(cameras)):
        few = slice(view, view + 1)
        rows.append(guidance.encode(shown[few], phase))
        if guidance.has_image_pass:
            seen.append(guidance.seen_base(base[few], phase))
    level = round(settings.attention_time * (len(guidance.alpha_bars) - 1))
    return LookedAt(torch.cat(rows), torch.cat(seen) if seen else None, level)


@torch.no_grad()
def attention_maps(
    task: EditTask, grid: VoxelGrid, cameras: CameraBatch, words: tuple[list[str], list[str]], settings: VoxeSettings
) -> Tensor:
    """(N, 2, 16, 16) attention to the words of the edit and of the object, in single views of the edited grid.

    Raises:
        UserError: the guidance is no diffusion model, or does not read the edit's words.
    """
    guidance, seen = refuse_without_attention(task), looked_at(task, grid, cameras, settings)
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
def difference_maps(task: EditTask, grid: VoxelGrid, cameras: CameraBatch, settings: VoxeSettings) -> Tensor:
    """(N, 2, L, L) where the network sees something else with the prompt than with the base prompt, and the rest.

        d = mean over channels and draws of |e(prompt) - e(base prompt)|, smoothed, over its 99th percentile, at most 1

    and 1 - d (DiffEdit, arXiv 2210.11427).
    """
    guidance, seen = refuse_without_attention(task), looked_at(task, grid, cameras, settings)
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
