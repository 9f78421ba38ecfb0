"""The one part that a prompt asks for, whichever model is to draw it."""

from __future__ import annotations

from fd_mitsuba.config.for_model import BUILTIN_WIDE
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt


def prompted_part(prompt: str | None, base_prompt: str = "", removed: bool = False) -> str | None:
    """The part's usual name; None where the prompt asks for none that any shipped prior knows, or for several.

    Args:
        removed: the part that it wants off.

    >>> prompted_part("a duck wearing sunglasses"), prompted_part("a duck with a crown and a cape")
    ('glasses', None)
    """
    vocabulary = vocabulary_of(BUILTIN_WIDE) if prompt else None
    if vocabulary is None:
        return None
    reading = read_prompt(prompt or "", vocabulary, base_prompt)
    parts = reading.removed if removed else reading.parts
    return parts[0] if len(parts) == 1 else None
