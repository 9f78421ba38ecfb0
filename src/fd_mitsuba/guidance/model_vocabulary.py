"""The words that a guidance model was trained with, looked up without loading the model."""

from __future__ import annotations

from pathlib import Path

from fd_mitsuba.guidance.builtin import shipped_folder
from fd_mitsuba.guidance.model_conventions import read_model_conventions
from fd_mitsuba.guidance.vocabulary import Vocabulary


def vocabulary_of(model: str, appearance: bool = False) -> Vocabulary | None:
    """The words that a guidance model was trained with; None where nobody has listed them, as of Stable Diffusion.

    Args:
        model: `builtin`, `builtin-wide`, a folder, or a hub id, of which nothing is known.
        appearance: of a built-in one, the prior of the appearance stage.
    """
    folder = shipped_folder(model, appearance) or Path(model).expanduser()
    return read_model_conventions(folder).vocabulary if folder.is_dir() else None
