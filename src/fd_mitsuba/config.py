"""How to edit: frozen, strict settings read from TOML, overridden by `--set`, dumped beside every run."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError, model_validator

from fd_mitsuba.config_sections import (
    AppearanceConfig,
    CamerasConfig,
    FieldConfig,
    GeometryConfig,
    GuidanceConfig,
    OutputConfig,
    Section,
    TextureConfig,
)
from fd_mitsuba.errors import UserError

_WITHOUT_EFFECT = {"guidance": ("device",)}
"""Settings that change where the work is done and not what comes out."""
_NEWER = {"geometry": {"lambda_tether": 0.0}}
"""Settings that came after the first runs, at the value that does nothing: so those runs can still be read."""


class RunConfig(Section):
    """Everything that decides a run besides the scene."""

    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    field: FieldConfig = FieldConfig()
    geometry: GeometryConfig = GeometryConfig()
    texture: TextureConfig = TextureConfig()
    appearance: AppearanceConfig = AppearanceConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    cameras: CamerasConfig = CamerasConfig()
    output: OutputConfig = OutputConfig()

    @model_validator(mode="after")
    def _ranges_are_ordered(self) -> RunConfig:
        for section, name, low, high in (
            ("guidance", "timestep_range_coarse", 0, 1),
            ("guidance", "timestep_range_refined", 0, 1),
            ("cameras", "elevation_deg", -90, 90),
            ("cameras", "fov_deg", 1, 150),
            ("geometry", "betas", 0, 1),
        ):
            first, last = getattr(getattr(self, section), name)
            if not (low <= first <= high and low <= last <= high and first <= last) or (name == "betas" and last >= 1):
                raise ValueError(f"{section}.{name} = ({first}, {last}) must be ordered and lie in [{low}, {high}]")
        return self

    def content_hash(self, stage: str = "geometry") -> str:
        """Sixteen hex digits that change with any setting that the stage depends on, its own and those before it."""
        later = {"texture", "appearance"} if stage == "geometry" else set()
        values = self.model_dump(mode="json", exclude=later)
        for section, names in _WITHOUT_EFFECT.items():
            for name in names:
                del values[section][name]
        for section, neutral in _NEWER.items():
            for name, value in neutral.items():
                if values[section][name] == value:
                    del values[section][name]
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


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
