"""The parts that a prompt asks for, whichever model is to draw them."""

from __future__ import annotations

import re

from fd_mitsuba.config.for_model import BUILTIN_WIDE
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.scene.usual_regions import PromptedParts


def prompted_part(prompt: str | None, base_prompt: str = "", removed: bool = False) -> str | None:
    """The part's usual name; None where the prompt asks for none that any shipped prior knows, or for several.

    Args:
        removed: the part that it wants off.

    >>> prompted_part("a duck wearing sunglasses"), prompted_part("a duck with a crown and a cape")
    ('glasses', None)
    """
    return prompted_parts(prompt, base_prompt, removed).only


def prompted_parts(prompt: str | None, base_prompt: str = "", removed: bool = False) -> PromptedParts:
    """All of the parts by their usual names; of several, a prompt for each alone, in the prompt's own words.

    Args:
        removed: the part that it wants off.

    >>> prompted_parts("a duck with a golden crown and a cape").alone
    {'crown': 'a duck with a golden crown', 'cape': 'a duck with a cape'}
    """
    vocabulary = vocabulary_of(BUILTIN_WIDE) if prompt else None
    if vocabulary is None:
        return PromptedParts(body=_first_words(prompt))
    reading = read_prompt(prompt or "", vocabulary, base_prompt)
    parts, body = reading.removed if removed else reading.parts, _first_words(prompt)
    if body is None or read_prompt(body, vocabulary).parts:  # "put a crown on it", "a man on a skateboard wearing ..."
        body = f"a {vocabulary.bodies[reading.bodies[0]][0]}" if reading.bodies else None
    if len(parts) == 1:
        return PromptedParts(parts[0], body=body)
    whole = base_prompt or body or "an object"
    alone = {} if removed else {name: f"{whole} with {words}" for name, words in reading.phrases.items()}
    return PromptedParts(alone=alone if len(alone) > 1 else {}, body=body)


def _first_words(prompt: str | None) -> str | None:
    """The words of a prompt before "with" and the like."""
    found = re.match(r"(.+?)\s+(?:with|wearing|carrying|holding|that has|which has)\s", prompt or "", re.IGNORECASE)
    return found[1] if found else None
