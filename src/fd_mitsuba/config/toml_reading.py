"""Settings as text: TOML files, shipped ones by name, overrides as of `--set`, and one line for what is wrong."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError

PRESETS_FOLDER = Path(__file__).with_name("presets")


def preset_names() -> list[str]:
    """Names of the settings that ship with the package: `paper`, `quick`, `smoke`."""
    return sorted(path.stem for path in PRESETS_FOLDER.glob("*.toml"))


def locate_settings(source: str | Path) -> Path:
    """The file of a shipped name such as `quick`, or the path itself; a file of that name here goes before."""
    path = Path(source)
    shipped = PRESETS_FOLDER / f"{source}.toml"
    return shipped if not path.is_file() and path.name == str(source) and shipped.is_file() else path


def read_toml(source: str | Path) -> dict[str, Any]:
    """The content of a TOML file or of shipped settings.

    Raises:
        UserError: no such file or name, unreadable, not TOML.
    """
    path = locate_settings(source)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        known = ", ".join(preset_names())
        raise UserError(f"{source}: no such config file; give one of {known}, or the path of a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{source}: cannot be read ({error}); give a readable TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{source}: not valid TOML ({error}); mend that line") from None


def apply_override(data: dict[str, Any], item: str) -> str:
    """Write the override's value into `data`; returns its key without blanks."""
    key, separator, text = item.partition("=")
    key, text = key.strip(), text.strip()
    if not separator or not key:
        raise UserError(f"--set {item}: write section.key=value, as in --set geometry.steps=200")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *sections, name = [part.strip() for part in key.split(".")]
    target = data
    for section in sections:
        if isinstance(target.get(section), str):  # the name of a choice, which may be followed by its options
            target[section] = {"kind": target[section]}
        target = target.setdefault(section, {})
        if not isinstance(target, dict):
            raise UserError(f"--set {item}: {section!r} is a value, not a section")
    target[name] = value
    return ".".join([*sections, name])


def read_choice(text: str) -> Choice:
    """A choice as words of the command line: `stl`, or with options `stl {scale = 1000}`.

    Raises:
        UserError: the options are no TOML table.
    """
    name, brace, options = text.partition("{")
    try:
        own = tomllib.loads(f"own = {brace}{options}")["own"] if brace else {}
    except tomllib.TOMLDecodeError:
        raise UserError(f"{text}: write NAME, or 'NAME {{key = value}}'") from None
    return Choice.of(name.strip(), own)


def guilty_override(error: ValidationError, items: dict[str, str]) -> str | None:
    """The last `--set` that wrote the value which the first problem is about; None: the value is the file's."""
    problem = error.errors()[0]
    place = ".".join(str(part) for part in problem["loc"])
    for key, item in reversed(items.items()):
        # A problem lies at the value, below it (one of a pair), above it (an unknown section), or names it in its text.
        about = f"{place}.".startswith(f"{key}.") or (place and f"{key}.".startswith(f"{place}."))
        if about or (not place and any(f"{key}{mark}" in problem["msg"] for mark in (" = ", "."))):
            return item
    return None


def first_problem(error: ValidationError, model: type[BaseModel]) -> str:
    problem = error.errors()[0]
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "value_error":  # our own words, about several values
        return f"{problem['ctx']['error']}; change the value"
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model) if "." in key else list(model.model_fields)
        near = difflib.get_close_matches(key, known, n=3, cutoff=0.4)
        hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(model.model_fields) or 'none'}"
        return f"unknown key {key!r}; {hint}"
    return f"{key + ': ' if key else ''}{problem['msg']} (given: {str(problem['input'])[:60]!r}); change the value"


def _known_keys(model: type[BaseModel]) -> list[str]:
    keys = []
    for name, info in model.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            keys += [f"{name}.{inner}" for inner in info.annotation.model_fields]
        else:
            keys.append(name)
    return keys
