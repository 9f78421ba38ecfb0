"""Read a prompt for a model that lists its words, or refuse it in one line that says how to reword it."""

from __future__ import annotations

from pathlib import Path

from fd_mitsuba.config.for_model import BUILTIN_FINE
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import PromptReading, read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary


def understood_prompt(prompt: str, vocabulary: Vocabulary, base_prompt: str = "") -> PromptReading:
    """The reading of a prompt that asks for a part that the model knows.

    Raises:
        UserError: it asks for none, or only names what to leave away.
    """
    reading = read_prompt(prompt, vocabulary, base_prompt)
    if reading.parts:
        return reading
    if reading.removed and not reading.unknown_parts:
        off = ", ".join(map(repr, reading.removed))
        raise UserError(
            f"prompt {prompt!r}: asks for no part, only for no {off}, and the built-in prior adds; name what to "
            'add, or, to take something off, give the focal region <string name="mode" value="subtract"/> and set '
            "geometry.lambda_sds=0"
        )
    unknown = ", ".join(map(repr, reading.unknown_parts))
    which = f"knows no part {unknown}" if unknown else "knows no such part"
    if (fine := vocabulary_of(BUILTIN_FINE)) is not None and vocabulary != fine:
        if known := read_prompt(prompt, fine, base_prompt).parts:
            raise UserError(
                f"prompt {prompt!r}: the built-in prior {which}, but the fine one knows {', '.join(known)}; "
                f"set guidance.model={BUILTIN_FINE}"
            )
    hint = " or ".join(map(repr, reading.nearest)) or ", ".join(vocabulary.parts)
    raise UserError(
        f"prompt {prompt!r}: the built-in prior {which}; nearest: {hint}; reword it "
        "(`fd_mitsuba prior` lists the words), or set guidance.model to a Stable Diffusion folder or hub id"
    )


def understood_part_prompt(part: str, prompt: str, vocabulary: Vocabulary, base_prompt: str = "") -> PromptReading:
    """The reading of a part's own prompt; UserError as `understood_prompt`, which names the part."""
    try:
        return understood_prompt(prompt, vocabulary, base_prompt)
    except UserError as error:
        raise UserError(f"part {part!r}: {error}") from None


def cuts_are_unknown(scene: Path) -> UserError:
    """Why a model that lists its words cannot guide regions that subtract."""
    return UserError(
        f"{scene}: its regions subtract, and the built-in prior knows only parts that are added; set "
        "geometry.lambda_sds=0 to cut out the regions themselves, or guidance.model to a Stable Diffusion folder"
    )
