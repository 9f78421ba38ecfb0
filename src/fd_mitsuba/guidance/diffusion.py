"""Guidance by a Diffusers pipeline in Stable Diffusion's layout: the adapter between pictures, network and `sds`.

One call of `guide`: views -> (mosaics) -> latents z -> z_t -> the UNet's noise -> gradient with respect to z -> back
through the encoder to the pictures. Pictures are handled in chunks, each of which ends with its gradient with respect
to the pictures; so the memory follows `views_per_call` in every phase, and the result does not depend on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.conventions import NormalSpace
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance import sds
from fd_mitsuba.guidance.conditions import Conditions
from fd_mitsuba.guidance.critic import Critic
from fd_mitsuba.guidance.denoiser import Denoiser
from fd_mitsuba.guidance.device import own_device, require_device
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceResult, GuidanceViews, NonFiniteGuidance, Phase
from fd_mitsuba.guidance.loading import Components, load_components
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.guidance.multiview import camera_conditions
from fd_mitsuba.guidance.normal_augmentation import random_turns, turned
from fd_mitsuba.guidance.picture_latents import PictureLatents
from fd_mitsuba.guidance.prompts import TextEmbeddings, unknown_words, view_prompt
from fd_mitsuba.guidance.step_draws import drawn_timesteps, own_share, step_generator
from fd_mitsuba.guidance.variants import VARIANTS, Area, Chunk, Distillation, VariationalScore

MASK_THRESHOLD = 0.1
"""A latent cell counts as the part's when the part covers at least this share of it."""


class DiffusionGuidance(Denoiser):
    """Score distillation with Stable Diffusion 1.x/2.x or an InstructPix2Pix model; see `interface.Guidance`.

    A UNet with 8 input channels sees the base's latents of the same view beside z_t and takes `image_guidance_scale` as
    second scale; one with 9 sees the base without the focal regions, grown by `mask_margin`, which it is to fill.

    `PictureLatents` says how pictures become latents.
    """

    def __init__(
        self,
        components: Components,
        config: GuidanceConfig,
        device: str = "cpu",
        appearance: AppearanceConfig | None = None,
    ) -> None:
        super().__init__(components, config, device)
        self.appearance = appearance or AppearanceConfig()
        self.variant = VARIANTS.make(config.variant, "guidance.variant")
        self.conventions = components.conventions
        if config.perp_neg and "guided" not in self.variant.passes:
            raise UserError(
                f"guidance.perp_neg = {config.perp_neg:g}: {config.variant.kind} makes no use of it; set it to 0"
            )
        self.critic: Critic | None = None
        if isinstance(self.variant, VariationalScore):
            own = self.variant.settings
            if config.dtype == "float16":
                raise UserError(
                    "guidance.variant = vsd: what its critic learns is too small for float16; set guidance.dtype to "
                    "bfloat16 or float32"
                )
            self.critic = Critic(components.unet, own.rank, own.learning_rate)
        self.view_grid = components.conventions.view_grid
        self.normal_space: NormalSpace | None = components.conventions.normal_space
        self.latents = PictureLatents(components.vae, components.conventions, config, self.latent_size)
        self.conditions = Conditions(self.latents, config, self.view_grid, self.device, components.folder)
        self._embed = TextEmbeddings(components.tokenizer, components.text_encoder, self.device, components.words)
        self._prompt: str | None = None
        self._negative_prompt = ""
        self._part_prompts: dict[str, tuple[str, str]] = {}

    @classmethod
    def load(
        cls, config: GuidanceConfig, device: str | None = None, appearance: AppearanceConfig | None = None
    ) -> DiffusionGuidance:
        """The guidance of `config.model`. Raises UserError as `loading.load_components` does.

        Args:
            device: instead of `config.device`.
            appearance: the settings of `guide_appearance`. With them the model `builtin` is the prior of colours, which
                serves that stage alone; a real model serves both.
        """
        place = str(require_device(device or own_device(config.device)))
        return cls(load_components(config, place, appearance is not None), config, place, appearance)

    def for_appearance(self, appearance: AppearanceConfig) -> DiffusionGuidance:
        """The guidance of the appearance stage; with the same networks in memory, unless the model is `builtin`."""
        if is_builtin(self.config.model):
            return self.load(self.config, str(self.device), appearance)
        return type(self)(self.components, self.config, str(self.device), appearance)

    def picture_size(self, phase: Phase) -> int:
        """Side in pixels of one view: the latents' own in the coarse phase, the VAE's input in the others."""
        at_latent_size = phase == "coarse" or (phase == "appearance" and self.latents.sees_shine)
        return self.latent_size * (1 if at_latent_size else self.latents.vae_scale_factor) // self.view_grid

    @property
    def appearance_size(self) -> int:
        """Side in pixels of a view of the appearance stage that needs no resizing."""
        return self.picture_size("appearance")

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """Take the texts; returns the words that the model cannot know (none where it has CLIP's own vocabulary)."""
        self._prompt, self._negative_prompt = prompt, negative_prompt
        if not self.conventions.whole_words:
            return []
        return unknown_words(self.components.tokenizer, f"{prompt} {negative_prompt}")

    def set_part_prompts(self, prompts: Mapping[str, tuple[str, str]]) -> None:
        """Take part -> (prompt, negative prompt) of the parts that have their own; "" is the scene's negative prompt.

        Where a part's focal regions are seen (`GuidanceViews.regions`), the network's noise is what it sees with these
        texts, elsewhere what it sees with those of `set_prompt`: one pass of the network more for each such part.
        """
        self._part_prompts = dict(prompts)

    @property
    def region_size(self) -> int | None:
        """Side in pixels of `GuidanceViews.regions`; None where they are not looked at."""
        return self.latent_size // self.view_grid if self._part_prompts or self.inpaints else None

    @property
    def control_sees(self) -> str | None:
        """What a ControlNet is shown in the appearance stage: `depth` or `normal`; None: there is none."""
        return self.config.controlnet_sees if self.components.controlnet is not None else None

    def prompts(self, views: GuidanceViews | AppearanceViews, text: str | None = None) -> list[str]:
        """The text of each picture or mosaic; a mosaic goes by its first view.

        Args:
            text: a part's, in place of the scene's prompt.
        """
        text = self._prompt if text is None else text
        if text is None:
            raise ValueError("set_prompt must be called before guide")
        return [
            view_prompt(text, float(azimuth), views.closeup, self.conventions, self.config.view_prompts)
            for azimuth in list(views.azimuth_deg)[:: self.view_grid**2]
        ]

    @network_threads()
    def guide(self, views: GuidanceViews, step: int, steps_total: int, phase: Phase, seed: int) -> GuidanceResult:
        """The loss whose gradient is the mean over pictures (mosaics) of the guidance gradient summed over latents.

            d loss / d pictures = (1 / N) sum over latents of  g dz / d pictures,   g = w(t) (e_hat - e)  for `sds`

        (paper, the SDS equations of "Preliminary" and "Geometry Editing"). `seed` and `step` decide t and the noise.

        Raises:
            NonFiniteGuidance: a NaN or an infinity in the gradient.
            ValueError: pictures of the wrong size or number, no base for a model that needs it.
        """
        size, wanted = views.pictures.shape[-1], self.picture_size(phase)
        if size != wanted:
            raise ValueError(f"the {phase} phase takes pictures of {wanted} x {wanted}, not {size} x {size}")
        pictures, shown = views.pictures, views.base
        if phase == "coarse" and self.config.normal_augmentation != "none":
            share, total = own_share(views)
            generator = step_generator(seed, step, phase, 1)
            turns = random_turns(total, self.config.normal_augmentation, generator)[share]
            pictures, shown = turned(pictures, turns), None if shown is None else turned(shown, turns)
        images, base = self._images(pictures, shown, phase)
        drawn = self._draw_for(views, step, steps_total, phase, seed)
        return self._distil(images, base, views, phase, *drawn, lesson=self._lesson(views, step, phase, seed))

    @network_threads()
    def guide_appearance(self, views: AppearanceViews, step: int, steps_total: int, seed: int) -> GuidanceResult:
        """As `guide`, for colours, with the settings of the appearance stage (paper, "Appearance Editing").

        Pictures of any size are resized to what the model takes. With `appearance.mask_guidance` noise and gradient are
        multiplied by the part's mask at the latents' size: 1 where the part covers at least `MASK_THRESHOLD` of a cell,
        or with `appearance.soft_mask` the share that it covers.
        """
        pictures, condition = views.pictures, views.condition
        if self.latents.sees_shine:
            pictures = torch.cat([pictures, views.shine], dim=1)
            condition = None if condition is None else torch.cat([condition, views.part_mask], dim=1)
        images, base = self._images(pictures, condition, "appearance")
        mask = None
        if self.appearance.mask_guidance:
            part = tile_views(views.part_mask, self.view_grid).to(self.device).detach()
            share = adaptive_avg_pool2d(part, self.latent_size)
            mask = share if self.appearance.soft_mask else (share >= MASK_THRESHOLD).to(images.dtype)
        drawn = self._draw_for(views, step, steps_total, "appearance", seed)
        lesson = self._lesson(views, step, "appearance", seed)
        return self._distil(images, base, views, "appearance", *drawn, mask, lesson)

    def encode(self, images: Tensor, phase: Phase) -> Tensor:
        """Scaled latents z (N, 4, L, L) of pictures or mosaics; see `PictureLatents`. Gradients flow."""
        return self.latents(images, phase)

    def seen_base(self, base: Tensor, phase: Phase) -> Tensor:
        """The base's latents as a network with 8 input channels sees them; see `Conditions.seen_base`."""
        return self.conditions.seen_base(base, phase)

    def _distil(
        self,
        images: Tensor,
        base: Tensor | None,
        views: GuidanceViews | AppearanceViews,
        phase: Phase,
        timesteps: Tensor,
        noise: Tensor,
        mask: Tensor | None = None,
        lesson: tuple[Tensor, Tensor] | None = None,
    ) -> GuidanceResult:
        self.looks_at_picture = phase == "appearance"
        how, count, (_, total) = self._how(phase), len(images), own_share(views)
        total //= self.view_grid**2
        texts = self.embeddings(self.prompts(views), self.passes(how))
        areas = self._areas(views, self.passes(how))
        holes = self.conditions.holes(views) if self.inpaints else None
        control = self.conditions.control(views, self.control_sees)
        together = self.views_together
        if count % together:
            raise ValueError(f"{count} views do not fill groups of {together}; give a multiple of {together}")
        cameras = None
        if self.takes_cameras:
            cameras = camera_conditions(views.azimuth_deg, views.elevation_deg).to(self.device)
        rows_per_chunk = max(1, self.config.views_per_call // len(texts) // together) * together
        track = images.requires_grad and torch.is_grad_enabled()

        picture_gradients, latent_gradients, previews = [], [], []
        critic_loss = 0.0
        for start in range(0, count, rows_per_chunk):
            rows = slice(start, start + rows_per_chunk)
            leaf = images[rows].detach().requires_grad_(track)
            with torch.set_grad_enabled(track):
                z = self.encode(leaf, phase)
            chunk = Chunk(
                z=z.detach(),
                noise=noise[rows],
                timesteps=timesteps[rows],
                texts={name: embedding[rows] for name, embedding in texts.items()},
                condition=self.conditions.beside_latents(
                    None if base is None else base[rows], None if holes is None else holes[rows], phase
                ),
                mask=None if mask is None else mask[rows],
                areas=tuple(area.rows(rows) for area in areas),
                control=None if control is None else control[rows],
                cameras=None if cameras is None else cameras[rows],
            )
            gradient, preview = self.latent_gradient(chunk, how)
            if self.critic is not None and lesson is not None and track:
                asked = replace(chunk, timesteps=lesson[0][rows], noise=lesson[1][rows])
                critic_loss += self.teach(asked, how, total)
            self._check_finite(gradient, chunk.timesteps, "latents")
            if track:
                picture_gradients.append(torch.autograd.grad(z, leaf, gradient)[0])
                self._check_finite(picture_gradients[-1], chunk.timesteps, "pictures")
            latent_gradients.append(gradient)
            previews.append(preview)

        if self.critic is not None and lesson is not None and track:
            self.critic.take_step()
        gradient = torch.cat(latent_gradients)
        # The way back to the pictures is linear, so that it may be scaled at its end, when all chunks are known.
        scale = 1 / total if self.config.reduction == "mean" else 1.0
        if self.config.normalise_gradient:
            scale *= sds.normalising_scale(gradient, mask) if total == count else _scale_of_all(gradient, mask)
        value = 0.5 * scale * float(gradient.square().sum())
        loss = images.new_tensor(value)
        if track:
            loss = sds.carry_gradient(images, scale * torch.cat(picture_gradients), value)
        loss = loss.cpu()  # beside the other losses, which know no other device
        logs = {
            "guidance_loss": value,
            "guidance_gradient_mean": float(gradient.abs().mean()),
            "guidance_gradient_max": float(gradient.abs().max()),
            "guidance_timestep": float(timesteps.float().mean()),
        }
        if self.critic is not None:
            logs["guidance_critic_loss"] = critic_loss
        return GuidanceResult(loss=loss, logs=logs, preview=torch.cat(previews))

    def _how(self, phase: Phase) -> Distillation:
        if phase == "appearance":
            settings, bounds = self.appearance, self.appearance.timestep_range
        else:
            settings = self.config
            bounds = settings.timestep_range_refined if phase == "refined" else settings.timestep_range_coarse
        return Distillation(
            self.variant,
            settings.weighting,
            settings.guidance_scale,
            settings.image_guidance_scale,
            bounds,
            self.config.perp_neg,
            self.critic,
        )

    def embeddings(self, prompts: list[str], passes: Iterable[str], negative: str = "") -> dict[str, Tensor]:
        """Text states (N, length, width) for each of the network's passes: the prompts, or the negative prompt.

        Args:
            negative: in place of that of `set_prompt`.
        """
        against = negative or self._negative_prompt
        read = {"text": prompts, "negative": [against] * len(prompts)}
        without = ["" if self.config.perp_neg else against] * len(prompts)
        return {name: self._embed(read.get(name, without)) for name in passes}

    def _areas(self, views: GuidanceViews | AppearanceViews, passes: Iterable[str]) -> tuple[Area, ...]:
        """Where the parts with texts of their own are seen; a pass that reads the same as elsewhere is left out."""
        found = []
        for part, (prompt, negative) in self._part_prompts.items():
            if part not in views.regions:
                raise ValueError(f"part {part!r} has a prompt, and the views do not say where its regions are seen")
            own = {"text"} if negative in ("", self._negative_prompt) else set(passes)
            if self.config.perp_neg:
                own &= {"text", "negative"}
            mask = tile_views(views.regions[part], self.view_grid).to(self.device)
            names = [name for name in passes if name in own]
            texts = self.embeddings(self.prompts(views, prompt), names, negative)
            found.append(Area(adaptive_avg_pool2d(mask, self.latent_size), texts))
        return tuple(found)

    def _images(self, pictures: Tensor, base: Tensor | None, phase: Phase) -> tuple[Tensor, Tensor | None]:
        """Pictures and, if the model sees it, the base, as mosaics on the network's device."""
        if self.needs_base and base is None:
            raise ValueError("this model needs the base's pictures of the same views")
        if not pictures.isfinite().all():
            cause = "the light or a material gives no number" if phase == "appearance" else "the surface has broken"
            raise NonFiniteGuidance(f"the pictures rendered for the {phase} phase are not finite; {cause}")
        images = tile_views(pictures, self.view_grid).to(self.device)
        if base is None or not self.needs_base:
            return images, None
        return images, tile_views(base, self.view_grid).to(self.device).detach()

    def _draw_for(
        self, views: GuidanceViews | AppearanceViews, step: int, steps_total: int, phase: Phase, seed: int
    ) -> tuple[Tensor, Tensor]:
        """`_draw` for these of the step's views."""
        share, total = own_share(views)
        grid = self.view_grid**2
        timesteps, noise = self._draw(total // grid, step, steps_total, phase, seed)
        own = slice(share.start // grid, share.stop // grid)
        return timesteps[own], noise[own]

    def _draw(self, count: int, step: int, steps_total: int, phase: Phase, seed: int) -> tuple[Tensor, Tensor]:
        """Timesteps (count,) and noise (count, 4, L, L); drawn on the CPU, so that the device does not change them."""
        generator = step_generator(seed, step, phase)
        progress = min(step / max(steps_total - 1, 1), 1.0)
        bounds, levels = self._how(phase).timestep_range, len(self.alpha_bars)
        # Views that are seen at once have one timestep, as in the training of such models.
        groups = count // self.views_together
        timesteps = drawn_timesteps(self.config, bounds, levels, groups, progress, generator)
        timesteps = timesteps.repeat_interleave(self.views_together)
        noise = torch.randn((count, 4, self.latent_size, self.latent_size), generator=generator)
        return timesteps.to(self.device), noise.to(self.device)

    def _lesson(
        self, views: GuidanceViews | AppearanceViews, step: int, phase: Phase, seed: int
    ) -> tuple[Tensor, Tensor] | None:
        """Timesteps, from the whole range, and noise of these views for the critic; None without one.

        It starts anew with a phase, whose latents are of another kind.
        """
        if self.critic is None:
            return None
        if step == 0:
            self.critic.reset()
        generator = step_generator(seed, step, phase, 2)
        share, total = own_share(views)
        grid, together = self.view_grid**2, self.views_together
        count = total // grid
        timesteps = torch.randint(1, len(self.alpha_bars), (count // together,), generator=generator)
        noise = torch.randn((count, 4, self.latent_size, self.latent_size), generator=generator)
        own = slice(share.start // grid, share.stop // grid)
        return timesteps.repeat_interleave(together)[own].to(self.device), noise[own].to(self.device)

    def learned_state(self) -> dict[str, Tensor]:
        """What was learned from step to step, for a checkpoint; empty but for the variant `vsd`."""
        return {} if self.critic is None else self.critic.state()

    def load_learned_state(self, state: dict[str, Tensor]) -> None:
        """Go on from a `learned_state`. Raises ValueError where it is of another model."""
        if self.critic is not None:
            self.critic.load_state(state)

    def _check_finite(self, gradient: Tensor, timesteps: Tensor, where: str) -> None:
        bad = ~gradient.isfinite().flatten(1).all(1)
        if bad.any():
            raise NonFiniteGuidance(
                f"{self.components.folder}: the guidance gradient of the {where} is not finite at timestep "
                f"{', '.join(str(int(t)) for t in timesteps[bad])}; set guidance.dtype to float32 or "
                "lower guidance.guidance_scale"
            )


def _scale_of_all(gradient: Tensor, mask: Tensor | None) -> float:
    """`sds.normalising_scale` over the views of all processes."""
    size = gradient.abs()
    covered = torch.ones_like(size) if mask is None else (mask.expand_as(size) > 0).to(size.dtype)
    total, cells = (processes().sum(float(values.sum())) for values in (size * covered, covered))
    return cells / max(total, torch.finfo(gradient.dtype).tiny) if cells else 1.0
