"""Give a guidance its prompt, and tell the user at once how it was read."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.prompt_reader import known_text
from fd_mitsuba.guidance.understood_prompt import understood_part_prompt, understood_prompt


def take_prompt(
    guidance: DiffusionGuidance,
    prompt: str,
    negative_prompt: str,
    say: Callable[[str], None],
    base_prompt: str = "",
    part_prompts: Mapping[str, tuple[str, str]] | None = None,
    subtracts: bool = False,
) -> None:
    """Set the prompts. A model that lists its words is told the caption of `prompt_reader.read_prompt`, and `say` hears
    how the prompt was read; any other model gets the prompts as they are.

    Args:
        part_prompts: part -> its own prompt and negative prompt, read in the same way.
        subtracts: whether the focal regions cut.

    Raises:
        UserError: the model lists its words, and a prompt asks for none of its parts, or takes none off in a cut.
    """
    parts = dict(part_prompts or {})
    vocabulary = guidance.conventions.vocabulary
    if vocabulary is None:
        unknown = guidance.set_prompt(prompt, negative_prompt)
        guidance.set_part_prompts(parts)
        if unknown:
            verb = "is" if len(unknown) == 1 else "are"
            say(f"the prompt's {', '.join(map(repr, unknown))} {verb} unknown to the model, which may draw anything")
        return
    reading = understood_prompt(prompt, vocabulary, base_prompt, subtracts)
    guidance.set_prompt(reading.caption, known_text(negative_prompt, vocabulary))
    say(f"prompt read as {reading.summary()}")
    told = {}
    for part, (own, negative) in parts.items():
        reading = understood_part_prompt(part, own, vocabulary, base_prompt, subtracts)
        told[part] = reading.caption, known_text(negative, vocabulary)
        say(f"prompt of part {part!r} read as {reading.summary()}")
    guidance.set_part_prompts(told)
