"""Mitsuba's errors as one line: what is wrong, in which line of the scene, and what to do."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_SOURCE = re.compile(r"\[[\w.]+\.(?:cpp|h|inl):\d+\]\s*")
_LOGGER = re.compile(r"\[[A-Z]\w*\]\s*")
_SCENE = "\0"  # stands for the scene's own path, which may hold blanks and colons
_LOCATION = re.compile(r"(?:string )?\(line (\d+), col \d+\)")
_LEAD = re.compile(
    r"(?:Error while loading|While loading|At|while processing <include>)\s*(?:dictionary node \"[^\"]*\"|\S*)\s*:\s*"
    r"|failed to instantiate \w+ plugin of type \"[^\"]*\"\s*:\s*"
)

_REMEDIES: tuple[tuple[str, str], ...] = (
    (r"missing version", 'write <scene version="3.0.0">'),
    (r"duplicate id", "give every element its own id"),
    (r"undefined parameter", "add a <default> for it, or give it with -D"),
    (r"unused parameter", "remove the option, or use the name in the scene"),
    (r"unknown property|unqueried", "correct its name or remove it"),
    (r"unresolved reference", "correct the id, or define the element"),
    (r"circular reference", "break the circle of <ref> elements"),
    (r"plugin .* not found", "correct the type"),
    (r"only one integrator", "keep one <integrator>, of type dual_path"),
    (r"well-formed|unsupported xml element|missing required attribute|unexpected", "mend the XML there"),
    (r"unsupported number of components", "it is CMYK or has an alpha; save the picture as RGB, or as PNG"),
    (r"value for field", "the file is cut short or holds a NaN; write it anew"),
    (r"unknown file format", "give a picture that Mitsuba reads, such as EXR, HDR, PNG or JPEG"),
    (r"could not parse|floating point|integer|boolean", "correct the value"),
    (r"not found|does not exist|no such file|unable to open|could not open", "correct the file name"),
    (r"unexpected end|truncated|eof|premature|invalid .*header|could not read|i/o error", "write the file anew"),
)


MITSUBA_ERRORS = (RuntimeError, UnicodeDecodeError)
"""What a call into Mitsuba raises: the second where its message quotes bytes of a file that are not UTF-8."""


def one_line(
    error: BaseException, path: Path, place: Callable[[int], tuple[str, str]] | None = None, mi: Any = None
) -> str:
    """A Mitsuba error as `file:line: <element>: what; remedy`, without source lines, colours or tracebacks.

    Args:
        path: the scene file, named where the error has no line.
        place: file and line, and the element there, of a line of what Mitsuba parsed; see `NormalisedXml.place`.
        mi: the module, to name the plugin nearest to an unknown one.
    """
    is_bytes = isinstance(error, UnicodeDecodeError)
    text = _COLOUR.sub("", error.object.decode(errors="backslashreplace") if is_bytes else str(error))
    if "Traceback (most recent call last)" in text:
        head, _, trace = text.partition("Traceback (most recent call last)")
        text = head + re.sub(r"^[\w.]+(?:Error|Exception): ", "", trace.strip().splitlines()[-1].strip())
    text = _SOURCE.sub("", text).replace(str(path), _SCENE)
    where, element = str(path), ""
    locations = _LOCATION.findall(text)
    if locations and place:
        found, element = place(int(locations[-1]))  # the innermost
        where = found or where
    text = _LEAD.sub("", _LOCATION.sub("", text))
    text = re.sub(r"(?:Parsing of XML file \"[^\"]*\"|XML parsing) failed\s*:", "not well-formed XML:", text)
    text = re.sub(r"Error while loading \w+ file \"[^\"]*\"\s*:\s*(?:\"[^\"]*\"\s*:\s*)?", "", text)
    text = re.sub(r"Found \d+ unreferenced propert\w+ in \w+ plugin of type \"[^\"]*\"\s*:", "unknown property", text)
    text = re.sub(r" in property \"_arg_\d+\"|Make sure the object with .*$|\(previous was at .*$", "", text)
    text = re.sub(r"\n\s*-\s*", " ", _LOGGER.sub("", text))
    text = " ".join(text.replace(_SCENE, str(path)).split()).strip(" .!;:")
    if text == "stof":
        text = "a number does not fit into 32 bits"
    remedy = remedy_for(text)
    unknown = re.search(r'Plugin "([^"]*)" not found', text)
    if unknown and (near := _nearest_plugin(mi, unknown.group(1))):
        remedy = f"nearest: {near}"
    return f"{where}: {element + ': ' if element else ''}{text}; {remedy}"


def remedy_for(text: str) -> str:
    """What to do about a message of Mitsuba."""
    return next((advice for pattern, advice in _REMEDIES if re.search(pattern, text, re.IGNORECASE)), "correct it")


def _nearest_plugin(mi: Any, name: str) -> str:
    if mi is None:
        return ""
    folder = Path(mi.__file__).parent / "plugins"
    known = [file.stem for file in folder.glob("*.so")] + ["focal_region", "dual_path"]
    return next(iter(difflib.get_close_matches(name, known, n=1, cutoff=0.5)), "")
