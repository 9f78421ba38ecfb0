"""Which of the shipped priors a prompt is for: `guidance.model = "builtin"` leaves that to the package.

The prior of that name knows sixteen parts, and knows them well; `builtin-wide` knows sixteen more, more bodies, and how
to take a part off. Where a prompt asks for what only the latter knows, or draws better, it takes the former's place.
"""

from __future__ import annotations

from collections.abc import Sequence

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.for_model import BUILTIN, BUILTIN_WIDE
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt

BETTER_IN_WIDE = frozenset({"top hat"})
"""Parts that both know; see `docs/prior.md` for how they were compared."""


def model_for_prompt(
    config: RunConfig, prompts: Sequence[str], base_prompt: str = "", subtracts: bool = False
) -> tuple[RunConfig, str | None]:
    """The settings with the prior that knows the parts of the prompts, and a line about it where it is another one.

    Args:
        prompts: of the run, and of single parts.
        subtracts: whether the focal regions cut, so that the prompts take something off.

    >>> config, line = model_for_prompt(RunConfig(), ["a cat with a halo"])
    >>> config.guidance.model, line
    ('builtin-wide', 'guidance.model: builtin-wide, which knows halo')
    """
    few, many = vocabulary_of(BUILTIN), vocabulary_of(BUILTIN_WIDE)
    if config.guidance.model != BUILTIN or few is None or many is None:
        return config, None
    new, better = [], []
    for prompt in prompts:
        before, reading = (read_prompt(prompt, words, base_prompt) for words in (few, many))
        new += [part for part in reading.parts if part not in before.parts]
        better += [part for part in reading.parts if part in BETTER_IN_WIDE]
    if not new and not better and not subtracts:
        return config, None
    guidance = config.guidance.model_copy(update={"model": BUILTIN_WIDE})
    why = f"knows {_listed(new)}" if new else f"draws {_listed(better)} better"
    why = "takes parts off" if subtracts else why
    return config.model_copy(update={"guidance": guidance}), f"guidance.model: {BUILTIN_WIDE}, which {why}"


def _listed(parts: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(parts))
