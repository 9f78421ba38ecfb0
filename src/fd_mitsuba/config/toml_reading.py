"""Settings as text: TOML files, shipped ones by name, overrides as of `--set`, and one line for what is wrong."""

from __future__ import annotations

import difflib
import re
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.io.safe_text import is_text

PRESETS_FOLDER = Path(__file__).with_name("presets")
_MOST_BYTES = 1 << 20
_TOO_LONG = re.compile(r"[0-9]{4000,}")
"""A whole number that Python does not read, or nearly so."""
_MOST_SHOWN = 60
"""Characters of a wrong value that a message repeats."""


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
        UserError: no such file or name, not a plain file, too large, unreadable, not TOML, nested too deep.
    """
    path = locate_settings(source)
    try:
        text = read_regular(path, _MOST_BYTES).decode()
        if number := _TOO_LONG.search(text):
            line = text.count("\n", 0, number.start()) + 1
            raise UserError(f"{source}: line {line}: a number of {len(number[0])} digits; shorten it")
        return tomllib.loads(text)
    except NotReadable as error:
        if str(error) == "not found":
            known = ", ".join(preset_names())
            raise UserError(f"{source}: no such config file; give one of {known}, or the path of a TOML file") from None
        raise UserError(f"{source}: {error}; give a readable TOML file") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{source}: cannot be read ({error}); save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{source}: not valid TOML ({error}); mend that line") from None
    except RecursionError:
        raise UserError(f"{source}: not valid settings (nested too deep); sections hold plain values") from None


def apply_override(data: dict[str, Any], item: str) -> str:
    """Write the override's value into `data`; returns its key without blanks."""
    key, separator, text = item.partition("=")
    key, text = key.strip(), text.strip()
    if not is_text(item):
        raise UserError(f"--set {shortened(item)}: holds bytes that are not UTF-8; give it in the terminal's encoding")
    if not separator or not key:
        raise UserError(f"--set {shortened(item)}: write section.key=value, as in --set geometry.steps=200")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # not TOML, a number of thousands of digits, brackets without end
        # A number that long is beyond every bound, and so is its beginning.
        value = int(text[:4000]) if _TOO_LONG.fullmatch(text) else text
    *sections, name = [part.strip() for part in key.split(".")]
    target = data
    for section in sections:
        if isinstance(target.get(section), str):  # the name of a choice, which may be followed by its options
            target[section] = {"kind": target[section]}
        target = target.setdefault(section, {})
        if not isinstance(target, dict):
            raise UserError(f"--set {shortened(item)}: {section!r} is a value, not a section")
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
        return f"{problem.get('ctx', {})['error']}; change the value"
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model) if "." in key else list(model.model_fields)
        near = difflib.get_close_matches(key, known, n=3, cutoff=0.4)
        hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(model.model_fields) or 'none'}"
        return f"unknown key {shortened(key)!r}; {hint}"
    return f"{key + ': ' if key else ''}{problem['msg']} (given: {_given(problem['input'])}); change the value"


def _given(value: object) -> str:
    try:
        return repr(shortened(str(value)))
    except (ValueError, RecursionError):  # more digits than Python writes, tables without end
        return "too long to be shown"


def shortened(text: str) -> str:
    """The text, or its beginning where it is long."""
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."


def _known_keys(model: type[BaseModel]) -> list[str]:
    keys = []
    for name, info in model.model_fields.items():
        if isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            keys += [f"{name}.{inner}" for inner in info.annotation.model_fields]
        else:
            keys.append(name)
    return keys
