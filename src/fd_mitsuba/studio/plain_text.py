"""Text for the page: no path of the server's disk in it."""

from __future__ import annotations

import re
from pathlib import Path

_FOLDERS = re.compile(r"(?<![\w.:/])/(?:[^\s/:'\"]+/)+")


def without_paths(text: str, *folders: Path) -> str:
    """The text with the names of folders left out: of `/home/me/cat/scene.xml` stays `scene.xml`.

    Args:
        folders: taken out first, whatever is in their names.
    """
    spellings = {str(form) for folder in folders for form in (folder, folder.resolve())} - {".", "/"}
    for spelling in sorted(spellings, key=len, reverse=True):
        text = text.replace(f"{spelling}/", "")
    return _FOLDERS.sub("", text)


def escaped(text: str) -> str:
    """Text as Markdown that shows it and nothing else."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]()<>#+!|" else letter for letter in text)
