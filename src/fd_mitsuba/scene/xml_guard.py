"""What a scene file says once its names are filled in and its includes are in place, and what of it is refused.

The file is read once, strictly; what comes out of it here is also what Mitsuba gets to read (`normalised_xml`), so that
the two cannot understand it differently. Refused is what makes Mitsuba crash, hang, or run foreign code.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass, field
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.object_nesting import is_object, refuse_deep_objects
from fd_mitsuba.scene.scene_copy import copied_files
from fd_mitsuba.scene.spectrum_file import spectrum_value
from fd_mitsuba.scene.xml_element import MAX_BYTES, MAX_NESTING, XmlElement, read_xml

MAX_INCLUDES = 15
MAX_FILES = 1000
"""Files that are included in all; a file may be included several times."""

_PLUGIN_TYPE = re.compile(r"[A-Za-z_][\w.-]*")
_NAME = re.compile(r"\w*")


@dataclass
class SceneText:
    """What the scan found.

    Attributes:
        root: `<scene>` with every `$name` filled in, every include in its place, and no `<default>` or `<path>` left.
        files: the XML files that were read, the scene first.
        paths: the folders of `<path>`, the last one first: in this order they are searched, before the scene's folder.
        spectra: `filename` of a `<spectrum>` -> the file that was read into its `value`.
        defaults: values of `<default>`, for names that `-D` does not set.
        used: the names that the scene uses.
    """

    root: XmlElement
    files: list[Path] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    spectra: dict[str, Path] = field(default_factory=dict)
    defaults: dict[str, str] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)


def scan_scene(path: Path, parameters: dict[str, str], all_used: bool = True) -> SceneText:
    """Read a scene file and what it includes, before Mitsuba sees any of it.

    Args:
        parameters: values for `$name`; they are literal, a `$` in them means nothing.
        all_used: refuse a parameter that the scene does not use.

    Raises:
        UserError: whatever `xml_element.read_xml` refuses; another root than `<scene>`, no version; a plugin type that
            is a path; a property or object given twice; an include outside the scene's folder, missing, circular or of
            another generation of Mitsuba; an undefined `$name`, a `-D` name that the scene does not use; objects nested
            too deep or in a circle; a spectrum's file that is not one.
    """
    scan = _Scan(path, parameters)
    text = scan.text
    for name in parameters if all_used else ():
        if not uses(text, name):
            known = sorted(text.used | set(text.defaults))
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
            hint = f"nearest: {near[0]}" if near else "it has no parameters; remove the option"
            raise UserError(f"{path}: -D {name}: the scene has no ${name}; {hint}")
    refuse_deep_objects(text.root)
    return text


def uses(text: SceneText, name: str) -> bool:
    """Whether a scene uses the parameter `name`."""
    return name in text.used


def refuse_plugin_path(where: str, plugin: str) -> None:
    """Raise UserError if a plugin type is anything but a name: Mitsuba would load it as a program library."""
    if not _PLUGIN_TYPE.fullmatch(plugin) or ".." in plugin:
        raise UserError(f"{where}: type {plugin!r} is not a plugin name; use letters, digits and underscores")


class _Scan:
    def __init__(self, path: Path, parameters: dict[str, str]) -> None:
        self.folder = path.resolve().parent
        self.known = dict(parameters)
        self.pattern: re.Pattern[str] | None = None
        self.bytes_left = MAX_BYTES
        self.copied = copied_files(path)
        self.names: dict[int, set[str]] = {}  # of what is below each object, by the object's id()
        self.depth = 0
        source = self._read(path, "scene")
        self.version = _version(source)
        root = XmlElement(source.tag, dict(source.attributes), path, source.line)
        self.text = SceneText(root, [path])
        self._fill(root)
        self._expand_children(source, root, 0)

    def _read(self, path: Path, root: str = "") -> XmlElement:
        element, size = read_xml(path, self.bytes_left, root)
        self.bytes_left -= size
        return element

    def _expand_children(self, source: XmlElement, target: XmlElement, includes: int) -> None:
        self.depth += 1
        for child in source.children:
            self._expand(child, target, includes)
        self.depth -= 1

    def _expand(self, source: XmlElement, parent: XmlElement, includes: int) -> None:
        element = XmlElement(source.tag, dict(source.attributes), source.file, source.line)
        self._fill(element)
        if self.depth >= MAX_NESTING:
            raise element.error(f"is nested deeper than {MAX_NESTING} elements; flatten the scene")
        if "type" in element.attributes:
            refuse_plugin_path(f"{element.where}: <{element.tag}>", element.attributes["type"])
        if element.tag in ("default", "path", "include") and source.children:
            raise source.children[0].error(f"cannot be in <{element.tag}>; move it out")
        if element.tag == "default":
            self._default(element)
        elif element.tag == "path":
            self._path(element, parent)
        elif element.tag == "include":
            self._include(element, parent, includes + 1)
        else:
            if element.tag == "spectrum" and "filename" in element.attributes and "type" not in element.attributes:
                self._spectrum(element)
            self._name(element, parent)
            parent.children.append(element)
            self._expand_children(source, element, includes)

    def _fill(self, element: XmlElement) -> None:
        """Replace `$name` by its value, the longest known name first, and `\\$` by `$`.

        As Mitsuba has it, but in one pass, so that no value becomes part of a name.
        """

        def filled(match: re.Match[str]) -> str:
            if match.group() == "\\$":
                return "$"
            name = match.group(1)
            if name is None:
                missing = _NAME.match(value, match.end()).group()  # type: ignore[union-attr]
                raise element.error(f"undefined parameter: ${missing}; add a <default> for it, or give it with -D")
            self.text.used.add(name)
            return self.known[name]

        for key, value in element.attributes.items():
            if "$" in value:
                if self.pattern is None:
                    longest = sorted(self.known, key=len, reverse=True)
                    names = "|".join(map(re.escape, longest))
                    self.pattern = re.compile(rf"\\\$|\$({names})?" if names else r"\\\$|\$(\0)?")
                element.attributes[key] = self.pattern.sub(filled, value)

    def _name(self, element: XmlElement, parent: XmlElement) -> None:
        name = element.attributes.get("name")
        if name and is_object(parent):
            taken = self.names.setdefault(id(parent), set())
            if name in taken:
                raise element.error(f"{parent} has {name!r} twice; keep one")
            taken.add(name)

    def _default(self, element: XmlElement) -> None:
        _check_attributes(element, ("name", "value"))
        name = element.attributes["name"]
        if not name:
            raise element.error("its name is empty; write the name of a parameter")
        if name not in self.known:
            self.known[name] = self.text.defaults[name] = element.attributes["value"]
            self.pattern = None

    def _path(self, element: XmlElement, parent: XmlElement) -> None:
        _check_attributes(element, ("value",))
        if parent is not self.text.root:
            raise element.error("can only be right below <scene>; move it there")
        value = element.attributes["value"]
        found = self._find(element, value)
        if not found.is_dir():
            raise element.error(f"folder {value!r} not found; correct the path")
        self.text.paths.insert(0, found.resolve())

    def _include(self, element: XmlElement, parent: XmlElement, includes: int) -> None:
        _check_attributes(element, ("filename",), ("name",))
        target = self._included(element)
        if includes > MAX_INCLUDES:
            raise element.error(f"includes are more than {MAX_INCLUDES} deep; break the circle")
        if len(self.text.files) > MAX_FILES:
            raise element.error(f"more than {MAX_FILES} files are included; put them together")
        self.text.files.append(target)
        source = self._read(target)
        if (_version(source)[0] < 2) != (self.version[0] < 2):  # then Mitsuba renames properties, file by file
            both = f"is of version {source.attributes['version']}, the scene of {self.text.root.attributes['version']}"
            raise element.error(f"{target} {both}; bring both to version 3.0.0")
        if source.tag == "scene":
            self._expand_children(source, parent, includes)
            return
        holder = XmlElement("scene", {}, target, source.line, [source])
        before = len(parent.children)
        self._expand_children(holder, parent, includes)
        for root in parent.children[before:]:
            root.attributes.pop("version", None)
            root.attributes.pop("name", None)
            if "name" in element.attributes:
                root.attributes["name"] = element.attributes["name"]

    def _included(self, element: XmlElement) -> Path:
        filename = element.attributes["filename"]
        target = element.file.parent / filename
        try:
            outside = not filename or not target.resolve().is_relative_to(self.folder)
            missing = not outside and not target.exists()
        except (OSError, ValueError, RuntimeError):  # too long, a NUL, a circle of symbolic links
            outside, missing = False, True
        if outside:
            raise element.error(f"{filename!r} lies outside the scene's folder; move it into {self.folder}")
        if missing:
            raise element.error(f"file {filename!r} not found; correct the name")
        return target

    def _spectrum(self, element: XmlElement) -> None:
        name = element.attributes["filename"]
        if "value" in element.attributes or not name:
            raise element.error("write either a value or the name of a file")
        path = self.copied.get(name) or self._find(element, name)
        element.attributes["value"] = spectrum_value(element, path)
        del element.attributes["filename"]
        self.text.spectra[name] = path

    def _find(self, element: XmlElement, name: str) -> Path:
        """The file or folder of that name beside the element's file, in a `<path>`, beside the scene, or as it is."""
        try:
            for folder in (element.file.parent, *self.text.paths, self.folder):
                if (folder / name).exists():
                    return folder / name
        except (OSError, ValueError):
            raise element.error(f"{name[:60]!r} is no file name; correct it") from None
        return Path(name)


def _check_attributes(element: XmlElement, needed: tuple[str, ...], optional: tuple[str, ...] = ()) -> None:
    for name in needed:
        if name not in element.attributes:
            raise element.error(f'missing required attribute "{name}"; mend the XML there')
    for name in element.attributes:
        if name not in (*needed, *optional):
            raise element.error(f'unexpected attribute "{name}"; mend the XML there')


def _version(root: XmlElement) -> tuple[int, ...]:
    given = root.attributes.get("version")
    if given is None:
        raise UserError(
            f'{root.where}: missing version attribute in root element <{root.tag}>; write <{root.tag} version="3.0.0">'
        )
    if not re.fullmatch(r"\d{1,6}\.\d{1,6}\.\d{1,6}", given, re.ASCII):
        raise UserError(f'{root.where}: version {given!r} is not a version; write <{root.tag} version="3.0.0">')
    return tuple(map(int, given.split(".")))
