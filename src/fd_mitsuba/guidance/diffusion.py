"""Guidance by a Diffusers pipeline in Stable Diffusion's layout: the adapter between pictures, network and `sds`.

One call of `guide`: views -> (mosaics) -> latents z -> z_t -> the UNet's noise -> gradient with respect to z -> back
through the encoder to the pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from fd_mitsuba.backend.threads import network_threads
from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.conventions import NormalSpace
from fd_mitsuba.guidance.chunk import Beside
from fd_mitsuba.guidance.conditions import Conditions
from fd_mitsuba.guidance.critic import Critic
from fd_mitsuba.guidance.denoiser import Denoiser
from fd_mitsuba.guidance.device import own_device, require_device
from fd_mitsuba.guidance.drafter import DiffusionDrafter
from fd_mitsuba.guidance.interface import AppearanceViews, GuidanceResult, GuidanceViews, NonFiniteGuidance, Phase
from fd_mitsuba.guidance.loading import Components, load_components
from fd_mitsuba.guidance.mosaic import tile_views
from fd_mitsuba.guidance.multiview import camera_conditions
from fd_mitsuba.guidance.network_passes import rows_at_once
from fd_mitsuba.guidance.normal_augmentation import random_turns, turned
from fd_mitsuba.guidance.picture_gradient import StepPictures, picture_gradient
from fd_mitsuba.guidance.picture_latents import PictureLatents
from fd_mitsuba.guidance.prompts import TextEmbeddings
from fd_mitsuba.guidance.query import Distillation, timestep_range
from fd_mitsuba.guidance.scene_texts import SceneTexts
from fd_mitsuba.guidance.step_draws import StepDraws, own_share, step_generator
from fd_mitsuba.guidance.variants import VARIANTS, VariationalScore, refuse_conflicts

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
        refuse_conflicts(config)
        self.critic = self._make_critic()
        self.view_grid = components.conventions.view_grid
        self.normal_space: NormalSpace | None = components.conventions.normal_space
        self.latents = PictureLatents(components.vae, components.conventions, config, self.latent_size)
        self.conditions = Conditions(
            self.latents,
            config,
            self.view_grid,
            self.device,
            components.folder,
            inpaints=self.inpaints,
            sees_region=self.sees_region,
        )
        embed = TextEmbeddings(components.tokenizer, components.text_encoder, self.device, components.words)
        self.texts = SceneTexts(embed, self.conventions, config, self.latent_size, self.device)
        self.draws = StepDraws(
            config,
            partial(timestep_range, config, self.appearance),
            len(self.alpha_bars),
            self.latent_size,
            self.view_grid,
            self.views_together,
            self.device,
        )

    def _make_critic(self) -> Critic | None:
        if not isinstance(self.variant, VariationalScore):
            return None
        own = self.variant.settings
        return Critic(self.components.unet, own.rank, own.learning_rate)

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

    @property
    def drafter(self) -> DiffusionDrafter | None:
        """Draws the edited object at once; None for a model that does not paint shapes on the base's."""
        return DiffusionDrafter(self) if self.conventions.is_packed and self.has_image_pass else None

    def set_prompt(self, prompt: str, negative_prompt: str = "") -> list[str]:
        """Take the texts; returns the words that the model cannot know (none where it has CLIP's own vocabulary)."""
        return self.texts.set_prompt(prompt, negative_prompt)

    def set_part_prompts(self, prompts: Mapping[str, tuple[str, str]]) -> None:
        """Take part -> (prompt, negative prompt) of the parts that have their own; "" is the scene's negative prompt.

        Where a part's focal regions are seen (`GuidanceViews.regions`), the network's noise is what it sees with these
        texts, elsewhere what it sees with those of `set_prompt`: one pass of the network more for each such part.
        """
        self.texts.set_part_prompts(prompts)

    @property
    def region_size(self) -> int | None:
        """Side in pixels of `GuidanceViews.regions`; None where they are not looked at."""
        return self.latent_size // self.view_grid if self.texts.of_parts or self.inpaints or self.sees_region else None

    @property
    def control_sees(self) -> str | None:
        """What a ControlNet is shown in the appearance stage: `depth` or `normal`; None: there is none."""
        return self.config.controlnet_sees if self.components.controlnet is not None else None

    def prompts(self, views: GuidanceViews | AppearanceViews, text: str | None = None) -> list[str]:
        """The text of each picture or mosaic; a mosaic goes by its first view.

        Args:
            text: a part's, in place of the scene's prompt.
        """
        return self.texts.prompts(views, text)

    def embeddings(self, prompts: list[str], passes: Iterable[str], negative: str = "") -> dict[str, Tensor]:
        """Text states (N, length, width) for each of the network's passes: the prompts, or the negative prompt.

        Args:
            negative: in place of that of `set_prompt`.
        """
        return self.texts.embeddings(prompts, passes, negative)

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
        drawn = self.draws.of_views(views, step, steps_total, phase, seed)
        return self._distil(images, base, views, phase, drawn, self._lesson(views, step, phase, seed))

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
        drawn = self.draws.of_views(views, step, steps_total, "appearance", seed)
        lesson = self._lesson(views, step, "appearance", seed)
        return self._distil(images, base, views, "appearance", drawn, lesson, mask)

    def encode(self, images: Tensor, phase: Phase) -> Tensor:
        """Scaled latents z (N, 4, L, L) of pictures or mosaics; see `PictureLatents`. Gradients flow."""
        return self.latents(images, phase)

    def seen_base(self, base: Tensor, phase: Phase) -> Tensor:
        """The base's latents as a network that sees them whole is shown them; see `Conditions.seen_base`."""
        return self.conditions.seen_base(base, phase)

    def _distil(
        self,
        images: Tensor,
        base: Tensor | None,
        views: GuidanceViews | AppearanceViews,
        phase: Phase,
        drawn: tuple[Tensor, Tensor],
        lesson: tuple[Tensor, Tensor] | None,
        mask: Tensor | None = None,
    ) -> GuidanceResult:
        self.looks_at_picture = phase == "appearance"
        how, count, together = self._how(phase), len(images), self.views_together
        if count % together:
            raise ValueError(f"{count} views do not fill groups of {together}; give a multiple of {together}")
        passes, total = self.passes(how), own_share(views)[1] // self.view_grid**2
        cameras = camera_conditions(views.azimuth_deg, views.elevation_deg) if self.takes_cameras else None
        control = self.conditions.control(views, self.control_sees)
        step = StepPictures(
            images,
            base,
            self.conditions.where(views),
            Beside(control=control, cameras=None if cameras is None else cameras.to(self.device)),
            *drawn,
            lesson,
            self.embeddings(self.prompts(views), passes),
            self.texts.areas(views, passes),
            mask,
            total,
        )
        rows = rows_at_once(self.config.views_per_call, len(step.texts), together)
        found = picture_gradient(step, self, self.latents, self.conditions, how, phase, rows)
        if self.critic is not None and lesson is not None and found.pictures is not None:
            self.critic.take_step()
        loss, value = found.loss(images, mask, total, self.config)
        logs = {
            "guidance_loss": value,
            "guidance_gradient_mean": float(found.latents.abs().mean()),
            "guidance_gradient_max": float(found.latents.abs().max()),
            "guidance_timestep": float(step.timesteps.float().mean()),
        }
        if self.critic is not None:
            logs["guidance_critic_loss"] = found.critic_loss
        # Its loss is to be added to others, which know no other device than the CPU.
        return GuidanceResult(loss=loss.cpu(), logs=logs, preview=found.previews)

    def _how(self, phase: Phase) -> Distillation:
        return Distillation.of_phase(phase, self.config, self.appearance, self.variant, self.critic)

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

    def _lesson(
        self, views: GuidanceViews | AppearanceViews, step: int, phase: Phase, seed: int
    ) -> tuple[Tensor, Tensor] | None:
        """What the critic, if any, is taught. It starts anew with a phase, whose latents are of another kind."""
        if self.critic is None:
            return None
        if step == 0:
            self.critic.reset()
        return self.draws.lesson(views, step, phase, seed)

    def learned_state(self) -> dict[str, Tensor]:
        """What was learned from step to step, for a checkpoint; empty but for the variant `vsd`."""
        return {} if self.critic is None else self.critic.state()

    def load_learned_state(self, state: dict[str, Tensor]) -> None:
        """Go on from a `learned_state`. Raises ValueError where it is of another model."""
        if self.critic is not None:
            self.critic.load_state(state)
