"""Whether a scene's prompt and its focal regions speak of the same parts; if not, what grows is not what was asked."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fd_mitsuba.config import RunConfig
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import FocalRegion


def prompt_warnings(scene: EditScene, config: RunConfig) -> list[str]:
    """A line for each misfit, with what to do; only for models that list their words."""
    vocabulary = vocabulary_of(config.guidance.model)
    if vocabulary is None or config.geometry.lambda_sds == 0:
        return []
    warnings = []
    there = set() if scene.subtracts else set(read_prompt(scene.base_prompt, vocabulary).parts)

    def asked(prompt: str) -> set[str]:
        reading = read_prompt(prompt, vocabulary, scene.base_prompt)
        return set(reading.removed if scene.subtracts else reading.parts) - there

    wanted, names = asked(scene.prompt), list(scene.parts)
    told = set().union(*(asked(prompt.prompt) for prompt in scene.part_prompts.values()))
    if scene.told_apart and wanted and told and wanted != told:
        warnings.append(
            f"the prompt speaks of {_listed(wanted)}, and the prompts of the regions, which count where they are seen, "
            f"of {_listed(told)}: say --at for regions of the new prompt, or change theirs"
        )
    elif len(wanted) > 1 and len(names) == 1 and not scene.earlier:  # those may have grown in an earlier round
        warnings.append(
            f"the prompt speaks of {_listed(wanted)}, and all regions are of one part: they grow as a mixture; an --at "
            "for each, in the prompt's order, puts them apart"
        )
    for (first, some), (second, others) in combinations(scene.parts.items(), 2):
        if any(_holds_middle(a, b) or _holds_middle(b, a) for a in some for b in others):
            warnings.append(
                f"parts {first} and {second}: their regions share a place, where both grow; move one of them"
            )
    return warnings


def _holds_middle(region: FocalRegion, of: FocalRegion) -> bool:
    low, high = of.bounds
    return bool(region.sdf(np.asarray((low + high) / 2)[None])[0] > 0)


def _listed(names: set[str]) -> str:
    return ", ".join(sorted(names))
