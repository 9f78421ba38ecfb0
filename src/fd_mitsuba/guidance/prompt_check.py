"""Give a guidance its prompt, and tell the user at once how it was read."""

from __future__ import annotations

from collections.abc import Callable

from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.prompt_reader import known_text
from fd_mitsuba.guidance.understood_prompt import understood_prompt


def take_prompt(
    guidance: DiffusionGuidance,
    prompt: str,
    negative_prompt: str,
    say: Callable[[str], None],
    base_prompt: str = "",
) -> None:
    """Set the prompts. A model that lists its words is told the caption of `prompt_reader.read_prompt`, and `say` hears
    how the prompt was read; any other model gets the prompts as they are.

    Raises:
        UserError: the model lists its words, and the prompt asks for none of its parts.
    """
    vocabulary = guidance.conventions.vocabulary
    if vocabulary is None:
        unknown = guidance.set_prompt(prompt, negative_prompt)
        if unknown:
            verb = "is" if len(unknown) == 1 else "are"
            say(f"the prompt's {', '.join(map(repr, unknown))} {verb} unknown to the model, which may draw anything")
        return
    reading = understood_prompt(prompt, vocabulary, base_prompt)
    guidance.set_prompt(reading.caption, known_text(negative_prompt, vocabulary))
    say(f"prompt read as {reading.summary()}")
