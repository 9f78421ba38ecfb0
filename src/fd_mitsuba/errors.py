"""The errors a user can cause or must be told about, each of which becomes one line and an exit code."""

from __future__ import annotations


class UserError(Exception):
    """Bad input: the message is one line that names the file, the element and what to do. Exit code 1."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class RunStopped(UserError):
    """A run that cannot go on (the part vanished, a NaN, an exploding field): says why. Exit code 1."""


class Interrupted(Exception):
    """SIGINT or SIGTERM after the checkpoint was written. Exit code 130."""
