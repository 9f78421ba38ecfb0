"""The errors a user can cause or must be told about, each of which becomes one line and an exit code."""

from __future__ import annotations

import re

_HIDDEN = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters: colours, titles, cursor
    "\u200e\u200f\u202a-\u202e\u2066-\u2069"  # writing direction, which shows text in another order
    "\u2028\u2029\ufeff\ud800-\udfff]"  # line separators, byte order mark, halves of characters
)

_NO_MEMORY = ("allocate memory", "out of memory", "bad_alloc", "bad alloc", "unable to allocate", "size calculation")
"""What NumPy, torch, Dr.Jit and the system say when there is not enough."""

_ADVICE = ". If you want to instead overwrite randomly initialized weights"
"""How Diffusers' advice to programmers begins, behind its complaint of a tensor's shape."""


class UserError(Exception):
    """Bad input: the message is one line that names the file, the element and what to do. Exit code 1."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(" ".join(message.split())))


class RunStopped(UserError):
    """A run that cannot go on (the part vanished, a NaN, an exploding field): says why. Exit code 1."""


class Interrupted(Exception):
    """SIGINT or SIGTERM after the checkpoint was written. Exit code 130."""


def first_line(error: BaseException) -> str:
    """The first line of another library's message, or the error's type where it has none."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[0].partition(_ADVICE)[0].strip() if lines else type(error).__name__)[:200]


def printable(line: str) -> str:
    """A line for a terminal or a log, with what would not be seen but obeyed shown as `\\x1b`."""
    return _HIDDEN.sub(lambda match: match.group().encode("unicode_escape", "surrogatepass").decode(), line)


def out_of_memory(error: BaseException) -> UserError | None:
    """An allocation that failed, as one line; None for any other error."""
    text = " ".join(str(error).split())
    if not isinstance(error, MemoryError) and not any(words in text.lower() for words in _NO_MEMORY):
        return None
    about = f" ({text[:160]})" if text else ""
    return UserError(
        f"out of memory{about}; free some, or lower what is large: sizes of pictures and textures, samples, views, "
        "guidance.views_per_call, geometry.grid_resolution, field.log2_table, the base's faces"
    )
