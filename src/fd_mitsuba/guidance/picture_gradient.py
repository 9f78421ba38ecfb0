"""From a step's pictures to the gradient with respect to them, a chunk of pictures at a time.

Each chunk ends with its gradient with respect to its pictures, so that the memory follows the chunks' size in every
phase, and the result does not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.chunk import Area, Beside, Chunk, some
from fd_mitsuba.guidance.conditions import Conditions
from fd_mitsuba.guidance.denoiser import Denoiser
from fd_mitsuba.guidance.interface import NonFiniteGuidance, Phase
from fd_mitsuba.guidance.picture_latents import PictureLatents
from fd_mitsuba.guidance.query import Distillation


@dataclass(frozen=True)
class StepPictures:
    """The pictures or mosaics of a step that this process works on, all (N, ...) on the network's device.

    Attributes:
        images: as the phase has them; gradients may be asked for.
        base: the unedited base, of the same views, or None.
        where: (N, 1, L, L), what an inpainting model is to paint, or where the part may be, or None.
        beside: what the network sees besides; its `condition` is made of `base` and `where`, chunk by chunk.
        timesteps: (N,); noise: (N, 4, L, L).
        lesson: the same for what the critic is taught, or None.
        texts: pass -> (N, length, width).
        areas, mask: as in `Chunk`.
        total: pictures of the step in all processes.
    """

    images: Tensor
    base: Tensor | None
    where: Tensor | None
    beside: Beside
    timesteps: Tensor
    noise: Tensor
    lesson: tuple[Tensor, Tensor] | None
    texts: dict[str, Tensor]
    areas: tuple[Area, ...]
    mask: Tensor | None
    total: int

    def chunk(self, rows: slice, z: Tensor, condition: Tensor | None) -> Chunk:
        """Some of the pictures, with their latents and what the network sees of the base."""
        return Chunk(
            z=z,
            noise=self.noise[rows],
            timesteps=self.timesteps[rows],
            texts={name: embedding[rows] for name, embedding in self.texts.items()},
            beside=replace(self.beside.rows(rows), condition=condition),
            mask=some(self.mask, rows),
            areas=tuple(area.rows(rows) for area in self.areas),
        )


@dataclass(frozen=True)
class StepGradient:
    """Of all pictures, not yet scaled.

    Attributes:
        latents: (N, 4, L, L) g with respect to z.
        pictures: g dz / d pictures, like the images; None where no gradient was asked for.
        previews: (N, 4, L, L) clean latents to show.
        critic_loss: sum over the chunks.
    """

    latents: Tensor
    pictures: Tensor | None
    previews: Tensor
    critic_loss: float

    def loss(self, images: Tensor, mask: Tensor | None, total: int, config: GuidanceConfig) -> tuple[Tensor, float]:
        """A scalar whose gradient with respect to the images is the guidance gradient, and its value: a size to log.

        Args:
            images, mask, total: of the `StepPictures`.
            config: whether pictures are summed up or averaged, and the gradient brought to a mean size of 1.
        """
        # The way back to the pictures is linear, so that it may be scaled at its end, when all chunks are known.
        scale = 1 / total if config.reduction == "mean" else 1.0
        if config.normalise_gradient:
            whole = total == len(images)
            scale *= (sds.normalising_scale if whole else _scale_of_all)(self.latents, mask)
        value = 0.5 * scale * float(self.latents.square().sum())
        if self.pictures is None:
            return images.new_tensor(value), value
        return sds.carry_gradient(images, scale * self.pictures, value), value


def picture_gradient(
    step: StepPictures,
    denoiser: Denoiser,
    encode: PictureLatents,
    conditions: Conditions,
    how: Distillation,
    phase: Phase,
    rows_per_chunk: int,
) -> StepGradient:
    """Work through the chunks; the critic, if any, is left with the gradients of its loss.

    Raises:
        NonFiniteGuidance: a NaN or an infinity in a gradient.
    """
    track = step.images.requires_grad and torch.is_grad_enabled()
    of_latents, of_pictures, previews = [], [], []
    critic_loss = 0.0
    for start in range(0, len(step.images), rows_per_chunk):
        rows = slice(start, start + rows_per_chunk)
        leaf = step.images[rows].detach().requires_grad_(track)
        with torch.set_grad_enabled(track):
            z = encode(leaf, phase)
        condition = conditions.beside_latents(some(step.base, rows), some(step.where, rows), phase)
        chunk = step.chunk(rows, z.detach(), condition)
        gradient, preview = denoiser.latent_gradient(chunk, how)
        if step.lesson is not None and track:
            timesteps, noise = step.lesson
            asked = replace(chunk, timesteps=timesteps[rows], noise=noise[rows])
            critic_loss += denoiser.teach(asked, how, step.total)
        _require_finite(gradient, chunk.timesteps, "latents", denoiser)
        if track:
            of_pictures.append(torch.autograd.grad(z, leaf, gradient)[0])
            _require_finite(of_pictures[-1], chunk.timesteps, "pictures", denoiser)
        of_latents.append(gradient)
        previews.append(preview)
    pictures = torch.cat(of_pictures) if track else None
    return StepGradient(torch.cat(of_latents), pictures, torch.cat(previews), critic_loss)


def _require_finite(gradient: Tensor, timesteps: Tensor, where: str, denoiser: Denoiser) -> None:
    bad = ~gradient.isfinite().flatten(1).all(1)
    if not bad.any():
        return
    folder = denoiser.components.folder
    for name in ("unet", "text_encoder", "vae"):
        weights = getattr(denoiser.components, name).parameters()
        if not all(bool(values.isfinite().all()) for values in weights):
            raise NonFiniteGuidance(f"{folder / name}: its weights have a NaN or an infinity; copy or fetch them again")
    raise NonFiniteGuidance(
        f"{folder}: the guidance gradient of the {where} is not finite at timestep "
        f"{', '.join(str(int(t)) for t in timesteps[bad])}; set guidance.dtype to float32 or "
        "lower guidance.guidance_scale"
    )


def _scale_of_all(gradient: Tensor, mask: Tensor | None) -> float:
    """`sds.normalising_scale` over the views of all processes."""
    size = gradient.abs()
    covered = torch.ones_like(size) if mask is None else (mask.expand_as(size) > 0).to(size.dtype)
    total, cells = (processes().sum(float(values.sum())) for values in (size * covered, covered))
    return cells / max(total, torch.finfo(gradient.dtype).tiny) if cells else 1.0
