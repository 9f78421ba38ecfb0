"""What is refused in a scene file before Mitsuba sees it, because Mitsuba would crash, hang, or run foreign code.

Read with a small scanner and not with an XML library: nothing is expanded, so entities are inert here as they are in
Mitsuba, and a tag that is nested too deep for a recursive parser costs nothing.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from pathlib import Path

from fd_mitsuba.errors import UserError

MAX_NESTING = 100
MAX_INCLUDES = 15

_SKIPPED = re.compile(r"<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<!DOCTYPE(?:[^\[>]|\[.*?\]\s*(?=>))*>", re.DOTALL)
_TAG = re.compile(r"<(/?)([A-Za-z_][\w.:-]*)((?:[^<>\"']|\"[^\"]*\"|'[^']*')*+)>")
_ATTRIBUTE = re.compile(r"([\w.:-]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")
_PARAMETER = re.compile(r"(?<!\\)\$([A-Za-z_]\w*)")
_PLUGIN_TYPE = re.compile(r"[A-Za-z_][\w.-]*")


@dataclass
class SceneText:
    """What the scan found: the files read, and the names that `-D` may set."""

    files: list[Path] = field(default_factory=list)
    defaults: dict[str, str] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)


def scan_scene(path: Path, parameters: dict[str, str], all_used: bool = True) -> SceneText:
    """Scan a scene file and what it includes, before anything is parsed or loaded.

    Args:
        all_used: refuse a parameter that the scene does not use.

    Raises:
        UserError: no such file, a folder, unreadable, not XML, empty, another root than `<scene>`, nesting deeper than
            `MAX_NESTING`, a plugin type that is a path, an include outside the scene's folder, missing or circular, a
            `-D` name that the scene does not use.
    """
    found = SceneText()
    _scan(path, path.resolve().parent, parameters, found, depth=0)
    for name in parameters if all_used else ():
        if not uses(found, name):
            known = sorted(found.used | set(found.defaults))
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
            hint = f"nearest: {near[0]}" if near else "it has no parameters; remove the option"
            raise UserError(f"{path}: -D {name}: the scene has no ${name}; {hint}")
    return found


def uses(text: SceneText, name: str) -> bool:
    """Whether a scene uses the parameter `name`."""
    # Mitsuba replaces the longest known name that follows a `$`, so that `$size2` uses `size` too.
    return any(used.startswith(name) for used in text.used)


def _scan(path: Path, folder: Path, parameters: dict[str, str], found: SceneText, depth: int) -> None:
    text = _read(path)
    found.files.append(path)
    blank = _SKIPPED.sub(lambda match: re.sub(r"[^\n]", " ", match.group()), text)
    if not blank.strip():
        raise UserError(f'{path}: the file is empty; write a Mitsuba scene, <scene version="3.0.0"> ... </scene>')
    nesting, root_seen = 0, False
    for tag in _TAG.finditer(blank):
        closing, name, rest = tag.group(1), tag.group(2), tag.group(3)
        if closing:
            nesting -= 1
            continue
        line = blank.count("\n", 0, tag.start()) + 1
        attributes = {match.group(1): match.group(2) or match.group(3) or "" for match in _ATTRIBUTE.finditer(rest)}
        if not root_seen and depth == 0 and name != "scene":
            raise UserError(f"{path}:{line}: the root element is <{name}>; a scene file starts with <scene>")
        root_seen = True
        nesting += 1
        if nesting > MAX_NESTING:
            raise UserError(f"{path}:{line}: <{name}> is nested deeper than {MAX_NESTING} elements; flatten the scene")
        found.used.update(parameter for value in attributes.values() for parameter in _PARAMETER.findall(value))
        if name == "default" and "name" in attributes:
            found.defaults.setdefault(attributes["name"], attributes.get("value", ""))
        if "type" in attributes:
            refuse_plugin_path(f"{path}:{line}: <{name}>", _filled(attributes["type"], parameters, found.defaults))
        if name == "include":
            target = _included(path, line, folder, _filled(attributes.get("filename", ""), parameters, found.defaults))
            if depth + 1 > MAX_INCLUDES:
                raise UserError(
                    f"{path}:{line}: <include>: includes are more than {MAX_INCLUDES} deep; break the circle"
                )
            _scan(target, folder, parameters, found, depth + 1)
        if rest.rstrip().endswith("/"):
            nesting -= 1
    if not root_seen:
        raise UserError(f'{path}: not an XML file; write a Mitsuba scene, <scene version="3.0.0"> ... </scene>')


def refuse_plugin_path(where: str, plugin: str) -> None:
    """Raise UserError if a plugin type is anything but a name: Mitsuba would load it as a program library."""
    if not _PLUGIN_TYPE.fullmatch(plugin) or ".." in plugin:
        raise UserError(f"{where}: type {plugin!r} is not a plugin name; use letters, digits and underscores")


def _read(path: Path) -> str:
    if path.is_dir():
        raise UserError(f"{path}: is a folder; give the scene file, such as {path / 'scene.xml'}")
    if not path.exists():
        raise UserError(f"{path}: no such scene file; give the path of a scene.xml")
    if not path.is_file():
        raise UserError(f"{path}: is not a regular file; give the path of a scene.xml")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if b"\0" in data[:4096] and not data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UserError(f"{path}: is a binary file, not XML; give the path of a scene.xml")
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    return data.decode(encoding, errors="replace")


def _filled(value: str, parameters: dict[str, str], defaults: dict[str, str]) -> str:
    known = {**defaults, **parameters}
    return _PARAMETER.sub(lambda match: known.get(match.group(1), match.group()), value)


def _included(path: Path, line: int, folder: Path, filename: str) -> Path:
    where = f"{path}:{line}: <include>"
    target = path.parent / filename
    if not filename or not target.resolve().is_relative_to(folder):
        raise UserError(f"{where}: {filename!r} lies outside the scene's folder; move it into {folder}")
    if not target.is_file():
        raise UserError(f"{where}: file {filename!r} not found; correct the name")
    return target
