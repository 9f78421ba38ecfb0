"""Models by name: a folder on this machine, or a snapshot of the Hugging Face hub."""

from __future__ import annotations

import os
import re
from collections.abc import Collection
from pathlib import Path

from fd_mitsuba.errors import UserError, first_line


def local_folder(model: str, setting: str, layout: str) -> Path | None:
    """The folder that a model's name is; None where it is a hub id.

    Args:
        setting: what the user gave the name to, such as `guidance.model`, for the message.
        layout: what the folder must hold, such as `Stable-Diffusion layout`.

    Raises:
        UserError: a file, or neither a folder nor of the form owner/name.
    """
    folder = Path(model).expanduser()
    if folder.is_dir():
        return folder
    if folder.exists() or not re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", model):
        problem = "is a file" if folder.exists() else "no such folder"
        raise UserError(f"{model}: {problem}; {setting} takes a folder in {layout} or a hub id owner/name")
    return None


def hub_snapshot(model: str, files: Collection[str], without: Collection[str] = ()) -> Path:
    """A folder with those of a hub repository's files that match `files`, fetched where they are not in the cache.

    `HF_HUB_OFFLINE=1` keeps to what is in the cache.

    Raises:
        UserError: unknown id, gated, no network, disk full, or offline and not in the cache.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        found = snapshot_download(
            model, allow_patterns=list(files), ignore_patterns=list(without), local_files_only=is_offline()
        )
        return Path(found)
    except LocalEntryNotFoundError:
        cause = "HF_HUB_OFFLINE is set" if is_offline() else "there is no connection"
        raise UserError(
            f"{model}: neither a folder here nor a hub model that is at hand ({cause} and it is not in the cache); "
            "give a folder, or fetch the model once while online"
        ) from None
    except Exception as error:  # the hub client raises many kinds
        raise UserError(
            f"{model}: neither a folder here nor fetched from the hub ({first_line(error)}); check the id, or "
            "give a folder"
        ) from None


def is_offline() -> bool:
    """Whether the hub must not be asked."""
    from huggingface_hub import constants

    said = os.environ.get("HF_HUB_OFFLINE", "").lower() in ("1", "true", "yes", "on")
    return bool(constants.HF_HUB_OFFLINE) or said
