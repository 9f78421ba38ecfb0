"""How often a step runs the network: what the forecast of a run's time counts."""

from __future__ import annotations

from collections.abc import Iterable

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance.interface import Phase
from fd_mitsuba.guidance.query import Distillation, pass_names, passes_of
from fd_mitsuba.guidance.scene_texts import own_passes
from fd_mitsuba.guidance.variants import VARIANTS


def rows_at_once(most: int, passes: int, together: int = 1) -> int:
    """Pictures in a chunk of a step.

    Args:
        most: pictures in one call of the network, `guidance.views_per_call`.
        passes: of the network, which see a picture each.
        together: consecutive pictures that are never parted.
    """
    return max(1, most // passes // together) * together


def network_passes(
    phase: Phase,
    config: GuidanceConfig,
    appearance: AppearanceConfig,
    has_image_pass: bool,
    pictures: int,
    negative_prompt: str = "",
    part_negatives: Iterable[str] = (),
) -> float:
    """Passes of the network for one picture in a step of a phase, on average; a pass backward is one more.

    Args:
        has_image_pass: whether classifier-free guidance has a third pass, see `Denoiser`.
        pictures: of a step.
        negative_prompt: the scene's.
        part_negatives: the negative prompt of each part that has prompts of its own, "" where it has no such.
    """
    how = Distillation.of_phase(phase, config, appearance, VARIANTS.make(config.variant, "guidance.variant"))
    names, every = pass_names(how, has_image_pass), passes_of(how, has_image_pass)
    texts = [own_passes(negative, negative_prompt, config.perp_neg, every) for negative in part_negatives]
    rows = min(pictures, rows_at_once(config.views_per_call, len(every)))
    return sum(
        often * sum(1 + sum(name in own for own in texts) for name in names[kind])
        for kind, often in how.variant.asked(how.timestep_range, rows).items()
    )
