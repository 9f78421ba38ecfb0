"""The settings reference: one table a section, from the models in `fd_mitsuba.config` and the shipped TOML files.

Names, ranges and defaults come from the models, the meaning from the docstring below each field or from its
`description`; `quick` and `paper` are the values that these settings come to.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import Any

from pydantic import BaseModel

from fd_mitsuba.config import RunConfig

PRESETS = ("quick", "paper")
HEADER = """# Settings

Settings are TOML: a section in brackets, then `name = value`. `-c` takes a file, or the name of shipped settings:
`quick` for the built-in prior, `paper` for Stable Diffusion, `smoke` to see in seconds that everything works. A file
holds only what differs from the defaults, which are the paper's. `--set section.name=value` overrides one value, and in
Python `fd.Config.load("quick", ["geometry.steps=200"])`.

The columns *quick* and *paper* name the value there where it differs from the default.
"""


def settings_page() -> str:
    """The page as Markdown."""
    shipped = {name: RunConfig.load(name).model_dump(mode="json") for name in PRESETS}
    top, sections = [], []
    for name, field in RunConfig.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            sections.append(_section(name, field.annotation, {key: run[name] for key, run in shipped.items()}))
        else:
            top.append(name)
    whole = table(RunConfig, top, shipped)
    return "\n".join([HEADER, "## Outside of sections\n", whole, *sections])


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """What the docstring below each field says, by the field's name; a `description` of the field goes before."""
    found = {}
    for base in reversed(model.__mro__):
        if not (isinstance(base, type) and issubclass(base, BaseModel)) or base is BaseModel:
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0].body  # type: ignore[attr-defined]
        for node, following in zip(body, body[1:], strict=False):
            if (
                isinstance(node, ast.AnnAssign)
                and isinstance(node.target, ast.Name)
                and isinstance(following, ast.Expr)
            ):
                if isinstance(following.value, ast.Constant) and isinstance(following.value.value, str):
                    found[node.target.id] = inspect.cleandoc(following.value.value)
    for name, field in model.model_fields.items():
        if field.description:
            found[name] = field.description
    return found


def _is_constant(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _section(name: str, model: type[BaseModel], shipped: dict[str, dict]) -> str:
    about = inspect.cleandoc(model.__dict__.get("__doc__") or "")
    return "\n".join([f"\n## `[{name}]`\n", f"{about}\n", table(model, list(model.model_fields), shipped)])


def table(model: type[BaseModel], names: list[str], shipped: dict[str, dict]) -> str:
    """The rows of some settings of a model; `shipped` has the values of each column by its name."""
    schema, meaning, usual = model.model_json_schema(), descriptions(model), model().model_dump(mode="json")
    rows = ["| setting | values | default | quick | paper | meaning |", "|---|---|---|---|---|---|"]
    for name in names:
        default, others = usual[name], [run[name] for run in shipped.values()]
        values = " | ".join("" if other == default else f"`{_toml(other)}`" for other in others)
        kind = _kind(schema["properties"][name], schema.get("$defs", {}))
        about = " ".join(meaning.get(name, "").split()).replace("|", "\\|")
        if "MAY_CHANGE" in map(repr, model.model_fields[name].metadata):
            about += " May change on `--resume`."
        rows.append(f"| `{name}` | {kind} | `{_toml(default)}` | {values} | {about} |")
    return "\n".join(rows) + "\n"


def _kind(schema: dict[str, Any], known: dict[str, Any]) -> str:
    """Type and range of a JSON schema, in a few words."""
    if "$ref" in schema:
        return _kind(known[schema["$ref"].rsplit("/", 1)[1]], known)
    if "enum" in schema or "const" in schema:
        return " or ".join(f"`{_toml(value)}`" for value in schema.get("enum", [schema.get("const")]))
    if "anyOf" in schema or "oneOf" in schema:
        return " or ".join(_kind(choice, known) for choice in schema.get("anyOf", schema.get("oneOf")))
    kind = schema.get("type", "value")
    if kind == "array":
        items = schema.get("prefixItems")
        return (
            f"{len(items)} × {_kind(items[0], known)}" if items else f"list of {_kind(schema.get('items', {}), known)}"
        )
    if kind == "object":
        return "name, or table with `kind`" if "kind" in schema.get("properties", {}) else "table"
    words = {"integer": "integer", "number": "number", "boolean": "`true` or `false`", "string": "text", "null": "none"}
    bounds = [
        f"{sign} {schema[key]}"
        for key, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
        if key in schema
    ]
    return " ".join([words.get(kind, kind), ", ".join(bounds)]).strip()


def _toml(value: Any) -> str:
    """A value as it is written in TOML; `none` for what is left out there."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {_toml(inner)}" for name, inner in value.items()) + "}"
    return str(value)
