"""What a prompt may be as a text, wherever it is written: in a scene, in a call, on the command line."""

from __future__ import annotations

MOST_CHARACTERS = 1000
"""Models read 77 tokens, which 400 characters nearly always fill; reading in people's words takes its time for each."""


def one_line_of(text: str) -> str:
    """The text with each run of blanks and line ends as one blank.

    >>> one_line_of(" a horse\\n  with wings ")
    'a horse with wings'
    """
    return " ".join(text.split())


def length_fault(text: str) -> str | None:
    """What is wrong with the length of a prompt, to follow its name; None: nothing."""
    if len(text) <= MOST_CHARACTERS:
        return None
    return f"has {len(text)} characters; describe the edited object in at most {MOST_CHARACTERS}"
