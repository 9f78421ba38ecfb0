"""Where the prior that is shipped with the package lies, and whether it is whole."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from fd_mitsuba.config.for_model import BUILTIN_WIDE, is_builtin
from fd_mitsuba.errors import UserError

BUILTIN_FOLDER = Path(__file__).resolve().parent.parent / "weights" / "shapes"
WIDE_FOLDER = BUILTIN_FOLDER.with_name("shapes_wide")
APPEARANCE_FOLDER = BUILTIN_FOLDER.with_name("colours")
WIDE_APPEARANCE_FOLDER = BUILTIN_FOLDER.with_name("colours_wide")
SUMS_NAME = "SHA256SUMS"


def shipped_folder(model: str, appearance: bool = False) -> Path | None:
    """Where the prior lies that a value of `guidance.model` names; None: it names none that is shipped.

    Args:
        appearance: the prior of colours that goes with it: it knows the same words.
    """
    if not is_builtin(model):
        return None
    if model == BUILTIN_WIDE:
        return WIDE_APPEARANCE_FOLDER if appearance else WIDE_FOLDER
    return APPEARANCE_FOLDER if appearance else BUILTIN_FOLDER


def builtin_folder(folder: Path = BUILTIN_FOLDER) -> Path:
    """The pipeline folder of a built-in prior, after its files were checked against `SHA256SUMS` if that is there.

    Args:
        folder: see `shipped_folder`.

    Raises:
        UserError: no prior in this installation, a file missing or changed, an unreadable list of hashes.
    """
    if not (folder / "model_index.json").is_file():
        raise UserError(
            f"{folder}: this installation has no built-in prior; reinstall fd_mitsuba, or set guidance.model to a "
            "Stable-Diffusion folder or hub id"
        )
    verify_hashes(folder)
    return folder


def write_hashes(folder: Path, files: Iterable[Path]) -> None:
    """Write `folder/SHA256SUMS` of files in that folder, as `verify_hashes` reads it."""
    lines = [
        f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(folder).as_posix()}\n" for p in sorted(files)
    ]
    (folder / SUMS_NAME).write_text("".join(lines), encoding="utf-8")


def verify_hashes(folder: Path) -> None:
    """Compare files with `folder/SHA256SUMS` (lines "<64 hex digits>  <relative path>", as `sha256sum` writes them).

    Raises:
        UserError: a listed file is missing or differs, or a line cannot be read. Without the list nothing is checked.
    """
    sums = folder / SUMS_NAME
    if not sums.is_file():
        return
    for number, line in enumerate(sums.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        expected, _, name = line.partition(" ")
        name = name.strip().removeprefix("*")
        if len(expected) != 64 or not name:
            raise UserError(f"{sums}: line {number} is not a hash and a file name; reinstall fd_mitsuba")
        path = folder / name
        if not path.is_file():
            raise UserError(f"{path}: file of the built-in prior is missing; reinstall fd_mitsuba")
        if hashlib.sha256(path.read_bytes()).hexdigest() != expected.lower():
            raise UserError(f"{path}: file of the built-in prior was changed or cut short; reinstall fd_mitsuba")
