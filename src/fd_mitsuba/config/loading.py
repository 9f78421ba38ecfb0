"""Settings read from TOML and overridden by `--set`; whatever is wrong becomes one line that names it."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from fd_mitsuba.config.run_config import RunConfig
from fd_mitsuba.errors import UserError


def load_config(path: Path | str | None, overrides: list[str] | tuple[str, ...] = ()) -> RunConfig:
    """The settings of a TOML file (None: the defaults, which are the paper's) after `section.key=value` overrides.

    Values of overrides are read as TOML, and as plain text where they are not TOML.

    Raises:
        UserError: unreadable file, unknown section or key, value of the wrong type or out of range.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise UserError(f"{path}: no such config file; give a path such as configs/quick.toml") from None
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{path}: cannot be read ({error}); give a readable TOML file") from None
        except tomllib.TOMLDecodeError as error:
            raise UserError(f"{path}: not valid TOML ({error}); mend that line") from None
    items = {_apply_override(data, item): item for item in overrides}
    try:
        return RunConfig.model_validate(data)
    except ValidationError as error:
        item = _guilty_override(error, items)
        source = f"--set {item}" if item is not None else path or "--set"
        raise UserError(f"{source}: {_first_problem(error)}") from None


def _apply_override(data: dict[str, Any], item: str) -> str:
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
        target = target.setdefault(section, {})
        if not isinstance(target, dict):
            raise UserError(f"--set {item}: {section!r} is a value, not a section")
    target[name] = value
    return ".".join([*sections, name])


def _guilty_override(error: ValidationError, items: dict[str, str]) -> str | None:
    """The last `--set` that wrote the value which the first problem is about; None: the value is the file's."""
    problem = error.errors()[0]
    place = ".".join(str(part) for part in problem["loc"])
    for key, item in reversed(items.items()):
        # A problem lies at the value, below it (one of a pair), above it (an unknown section), or names it in its text.
        about = f"{place}.".startswith(f"{key}.") or (place and f"{key}.".startswith(f"{place}."))
        if about or (not place and any(f"{key}{mark}" in problem["msg"] for mark in (" = ", "."))):
            return item
    return None


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    key = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "value_error":  # our own words, about several values
        return f"{problem['ctx']['error']}; change the value"
    if problem["type"] == "extra_forbidden":
        known = _known_keys() if "." in key else list(RunConfig.model_fields)
        near = difflib.get_close_matches(key, known, n=3, cutoff=0.4)
        hint = f"nearest: {', '.join(near)}" if near else f"sections: {', '.join(RunConfig.model_fields)}"
        return f"unknown key {key!r}; {hint}"
    return f"{key + ': ' if key else ''}{problem['msg']} (given: {str(problem['input'])[:60]!r}); change the value"


def _known_keys() -> list[str]:
    keys = []
    for name, info in RunConfig.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            keys += [f"{name}.{inner}" for inner in info.annotation.model_fields]
        else:
            keys.append(name)
    return keys
