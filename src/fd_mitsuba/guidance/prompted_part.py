"""The parts that a prompt asks for, whichever model is to draw them."""

from __future__ import annotations

import re

from fd_mitsuba.config.for_model import BUILTIN_WIDE
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.vocabulary import WITHOUT
from fd_mitsuba.scene.usual_regions import HEADLESS, PromptedParts


def prompted_parts(prompt: str | None, base_prompt: str = "", removed: bool = False) -> PromptedParts:
    """All of the parts by their usual names; of several, a prompt for each alone, in the prompt's own words.

    Args:
        base_prompt: what it says of the object now; the parts in it are there already.
        removed: the parts that it wants off.

    >>> prompted_parts("a duck wearing sunglasses").only
    'glasses'
    >>> prompted_parts("a duck with a golden crown and a cape").alone
    {'crown': 'a duck with a golden crown', 'cape': 'a duck with a cape'}
    """
    vocabulary = vocabulary_of(BUILTIN_WIDE) if prompt else None
    if vocabulary is None:
        return PromptedParts(body=_first_words(prompt))

    def bare(text: str | None) -> str | None:
        """What names the object and no part: not "a man on a skateboard", not "a cow without horns and"."""
        found = read_prompt(text, vocabulary) if text else None
        return None if found is None or found.parts or found.removed or _first_words(text) else text

    reading = read_prompt(prompt or "", vocabulary, base_prompt)
    noun = f"a {vocabulary.bodies[reading.bodies[0]][0]}" if reading.bodies else None
    headless = bool(reading.bodies) and reading.bodies[0] in HEADLESS
    body = bare(_first_words(prompt)) or noun
    there = read_prompt(base_prompt, vocabulary).parts if base_prompt and not removed else ()
    named = reading.removed if removed else reading.parts
    parts = [name for name in named if name in vocabulary.parts and name not in there]
    if len(parts) < 2:
        return PromptedParts(next(iter(parts), None), body=body, headless=headless)
    whole, link = bare(base_prompt) or body or "an object", WITHOUT if removed else "with"
    phrases = {name: vocabulary.parts[name][0] if removed else reading.phrases[name] for name in parts}
    alone = {name: f"{whole} {link} {words}" for name, words in phrases.items()}
    return PromptedParts(alone=alone, body=body, headless=headless)


def _first_words(prompt: str | None) -> str | None:
    """The words of a prompt before "with" and the like."""
    found = re.match(r"(.+?)\s+(?:with|wearing|carrying|holding|that has|which has)\s", prompt or "", re.IGNORECASE)
    return found[1] if found else None
