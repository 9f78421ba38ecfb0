"""Read a prompt for a model that lists its words, or refuse it in one line that says how to reword it."""

from __future__ import annotations

from fd_mitsuba.config.for_model import BUILTIN_WIDE
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import PromptReading, read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary


def understood_prompt(
    prompt: str, vocabulary: Vocabulary, base_prompt: str = "", subtracts: bool = False
) -> PromptReading:
    """The reading of a prompt that asks for a part that the model knows, or takes one off.

    Args:
        subtracts: whether the focal regions cut, so that the prompt must take a part off and ask for none.

    Raises:
        UserError: the prompt does not fit, or the model has not learned to take parts off.
    """
    if subtracts:
        return _understood_removal(prompt, vocabulary, base_prompt)
    reading = read_prompt(prompt, vocabulary, base_prompt)
    if reading.parts:
        return reading
    if reading.removed and not reading.unknown_parts:
        off = ", ".join(map(repr, reading.removed))
        raise UserError(
            f"prompt {prompt!r}: asks for no part, only for no {off}, where the focal regions add; name what to "
            'add, or, to take something off, give the focal region <string name="mode" value="subtract"/> '
            "(--subtract)"
        )
    raise UserError(f"prompt {prompt!r}: {_unknown(reading, prompt, vocabulary, base_prompt)}")


def _understood_removal(prompt: str, vocabulary: Vocabulary, base_prompt: str) -> PromptReading:
    if not vocabulary.takes_off:
        raise UserError(
            "the focal regions subtract, and this prior knows only parts that are added; set "
            f"guidance.model={BUILTIN_WIDE}, which can take parts off, or geometry.lambda_sds=0 to cut out the regions "
            "as they are, or guidance.model to a Stable Diffusion folder"
        )
    reading = read_prompt(prompt, vocabulary, base_prompt)
    if reading.parts:
        wanted = ", ".join(reading.parts)
        raise UserError(
            f"prompt {prompt!r}: asks for {wanted}, where the focal regions subtract; say what to take off, as in "
            '"a mug without a handle", leave mode="subtract" out, or set geometry.lambda_sds=0 to cut out the '
            "regions as they are"
        )
    if not reading.caption:
        off = ", ".join(map(repr, (*reading.removed, *reading.ignored)))
        raise UserError(
            f"prompt {prompt!r}: takes off no part that the built-in prior knows"
            + (f", for it does not know {off}" if off else "")
            + '; say it as in "a mug without a handle" (`fd_mitsuba prior` lists the words)'
        )
    if reading.doubtful:
        raise UserError(
            f"prompt {prompt!r}: can be read both ways, and regions that subtract would take off "
            f'{", ".join(reading.removed)}; say plainly what is to go, as in "a mug without a handle"'
        )
    return reading


def _unknown(reading: PromptReading, prompt: str, vocabulary: Vocabulary, base_prompt: str) -> str:
    """What the prior does not know, and what may have been meant."""
    unknown = ", ".join(map(repr, reading.unknown_parts))
    which = f"knows no part {unknown}" if unknown else "knows no such part"
    wide = vocabulary_of(BUILTIN_WIDE)
    if wide is not None and vocabulary.parts != wide.parts:
        if known := read_prompt(prompt, wide, base_prompt).parts:
            return (
                f"this prior {which}, but the wide built-in one knows {', '.join(known)}; "
                f"set guidance.model={BUILTIN_WIDE}"
            )
    hint = " or ".join(map(repr, reading.nearest)) or ", ".join(vocabulary.parts)
    return (
        f"the built-in prior {which}; nearest: {hint}; reword it (`fd_mitsuba prior` lists the words), or set "
        "guidance.model to a Stable Diffusion folder or hub id"
    )


def understood_part_prompt(
    part: str, prompt: str, vocabulary: Vocabulary, base_prompt: str = "", subtracts: bool = False
) -> PromptReading:
    """The reading of a part's own prompt; UserError as `understood_prompt`, which names the part."""
    try:
        return understood_prompt(prompt, vocabulary, base_prompt, subtracts)
    except UserError as error:
        raise UserError(f"part {part!r}: {error}") from None
