"""Give a guidance its prompt, and tell the user at once what of it the model cannot know."""

from __future__ import annotations

from collections.abc import Callable

from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.guidance.vocabulary import read_prompt


def take_prompt(guidance: DiffusionGuidance, prompt: str, negative_prompt: str, say: Callable[[str], None]) -> None:
    """Set the prompts; a remark names the words that a model with a listed vocabulary will ignore.

    Raises:
        UserError: the model's vocabulary is listed and the prompt asks for none of its parts.
    """
    unknown = guidance.set_prompt(prompt, negative_prompt)
    vocabulary = guidance.conventions.vocabulary
    if vocabulary is not None:
        reading = read_prompt(prompt, vocabulary)
        if not reading.parts:
            hint = " or ".join(map(repr, reading.nearest)) or ", ".join(vocabulary.parts)
            raise UserError(
                f"prompt {prompt!r}: the built-in prior knows no such part; nearest: {hint}; reword it "
                "(`fd_mitsuba prior` lists the words), or set guidance.model to a Stable Diffusion folder or hub id"
            )
        unknown = list(reading.ignored)
    if unknown:
        verb = "is" if len(unknown) == 1 else "are"
        say(
            f"the prompt's {', '.join(map(repr, unknown))} {verb} outside the built-in prior's vocabulary and will not "
            "steer the result; `fd_mitsuba prior` lists the words it knows"
        )
