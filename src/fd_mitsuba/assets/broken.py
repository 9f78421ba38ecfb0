"""Why an asset cannot be read."""

from __future__ import annotations


class BrokenAsset(Exception):
    """The asset cannot be taken in; the text says what is wrong and what to do, without the file's name."""
